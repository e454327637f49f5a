"""A policy with absolute actions and the same one with relative ones move an arm in the same
way.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    ConfigError,
    Contract,
    Obs,
    PlayerSettings,
)
from vlagents_ray.abilities import ContinuesPlans, ability
from vlagents_ray.contract import CameraSpec, StateSpec
from vlagents_ray.errors import MissingState
from vlagents_ray.interface import DELAY, DISTRIBUTION, LEFTOVER
from vlagents_ray.policies.absolute_actions import AbsoluteActions, AbsoluteActionsConfig
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.testing import check_agent

# rad; the last column, a gripper's, is never relative.
GOAL = np.array([1.0, -2.0, 0.5], np.float32)
HORIZON, TICKS = 12, 40
ARM = Contract(
    cameras={"front": CameraSpec(32, 32)},
    state={"joints": StateSpec(3), "arm": StateSpec(2)},  # the arm without its gripper
    action=ActionSpec(dim=3, delta=False),
)


class Reaching(Agent):
    """A policy whose rows each move two fifths of the remaining way, from the measured pose or from
    the given rows.
    """

    shared = ("gate",)
    continues_plans = True

    def __init__(
        self, *, relative: bool = False, gated: bool = False, action: ActionSpec | None = None
    ) -> None:
        self.relative, self.gated = relative, gated
        self.action = action or ActionSpec(dim=3, delta=relative)
        self.gate = threading.Semaphore(0)
        self.acts = 0

    @property
    def contract(self) -> Contract:
        return Contract(action=self.action)

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        if self.gated and self.acts > 1:  # `reset` waits for the first answer
            assert self.gate.acquire(timeout=30)
        pose = obs.state["joints"]
        origin = (
            np.append(pose[:2], 0).astype(np.float32) if self.relative else np.zeros(3, np.float32)
        )
        rows = [pose]
        if LEFTOVER in obs.info:
            given = obs.info[LEFTOVER] + origin
            rows = [*given[: obs.info.get(DELAY, 0)]] or [given[0]]
        while len(rows) < HORIZON:
            rows.append(rows[-1] + 0.4 * (GOAL - rows[-1]))
        chunk = np.stack(rows) - origin
        return Act(
            chunk.astype(np.float32),
            info={DISTRIBUTION: {"mean": chunk, "std": np.ones_like(chunk)}},
        )


def absolute(agent: Agent, **settings: Any) -> AbsoluteActions:
    return AbsoluteActions(
        agent, AbsoluteActionsConfig(**{"state": ["arm"], "absolute": [-1], **settings})
    )


def poses(inner: Reaching, agent: Agent, ticks_late: int, **settings: Any) -> np.ndarray:
    """Return the joints at each tick, (TICKS, 3) rad. Each answer arrives `ticks_late` ticks after
    the last one.
    """
    robot, found = SimulatedRobot(ARM), []
    player = ChunkPlayer(agent, PlayerSettings(**settings))
    agent.initialize()
    player.reset(robot.observe())
    for tick in range(TICKS):
        obs = robot.observe()
        found.append(obs.state["joints"])
        if tick == TICKS // 2:
            robot.stop()
            player.interrupt()
        robot.apply(player.act(obs).action)
        caller = player._caller
        if caller is not None and not caller.idle and tick % ticks_late == 0:
            inner.gate.release()
            wait_for(lambda caller=caller: not caller.busy, every_s=0.001)
    inner.gate.release(100)
    player.close()
    return np.stack(found)


@pytest.mark.parametrize("ticks_late", [1, 4])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"execute": 5},
        {"mode": "ensemble"},
        {"mode": "async"},
        {"mode": "async", "merge": "average"},
        {"mode": "async", "real_time_chunking": True},
        {"mode": "async", "real_time_chunking": True, "execute": 3},
    ],
)
def test_relative_actions_move_the_arm_as_absolute_ones_do(
    settings: dict[str, Any], ticks_late: int
) -> None:
    gated = settings.get("mode") == "async"
    own, relative = Reaching(gated=gated), Reaching(relative=True, gated=gated)
    wanted = poses(own, own, ticks_late, **settings)
    np.testing.assert_allclose(
        poses(relative, absolute(relative), ticks_late, **settings), wanted, atol=1e-5
    )
    assert own.acts == relative.acts
    assert np.abs(wanted[-1] - GOAL).max() < 0.1  # the arm reaches its goal


def test_a_plan_comes_back_as_it_was_given_from_another_pose() -> None:
    agent = absolute(Reaching(relative=True))
    agent.initialize()
    plan = np.linspace(-1, 1, 15, dtype=np.float32).reshape(5, 3)
    obs = Obs(state={"joints": np.ones(3, np.float32), "arm": np.ones(2, np.float32)})
    obs.info |= {LEFTOVER: plan, DELAY: 4}
    act = agent.act(obs)
    np.testing.assert_allclose(act.action[:4], plan[:4], atol=1e-6)
    np.testing.assert_array_equal(act.info[DISTRIBUTION]["mean"], act.action)
    assert (act.info[DISTRIBUTION]["std"] == 1).all()
    assert obs.info[LEFTOVER] is plan
    plans = ability(agent, ContinuesPlans)
    assert plans is not None
    assert plans.continues_plans


def test_the_contract_says_that_actions_are_absolute_and_what_state_they_need() -> None:
    contract = absolute(Reaching(relative=True)).contract
    assert contract is not None
    assert contract.action == ActionSpec(dim=3, delta=False)
    assert contract.state == {"arm": StateSpec(2)}


def test_a_session_whose_state_is_missing_fails_alone() -> None:
    agent = absolute(Reaching(relative=True))
    full = Obs(state={"joints": np.ones(3, np.float32), "arm": np.ones(2, np.float32)})
    without = Obs(state={"joints": np.ones(3, np.float32)})
    bad, good = agent.act_batch(
        [without, full], [absolute(Reaching(relative=True)) for _ in range(2)]
    )
    assert isinstance(bad, MissingState)
    assert isinstance(good, Act)


def test_it_is_named_in_a_deployment_and_keeps_the_contract_of_an_agent() -> None:
    agent = build_agent("noop", {"chunk": 3}, [{"absolute_actions": {"state": ["joints"]}}])
    assert isinstance(agent, AbsoluteActions)
    check_agent(agent)


def test_a_policy_that_returns_rows_of_earlier_chunks_is_refused() -> None:
    settings = {"checkpoint": "anywhere", "actions": "queue"}
    with pytest.raises(ConfigError, match="expected a policy with actions: chunk"):
        build_agent("reference", settings, [{"absolute_actions": {"state": ["joints"]}}])


@pytest.mark.parametrize(
    "action",
    [
        ActionSpec(dim=3, delta=False),
        ActionSpec(dim=3, space="joint_velocity"),
        ActionSpec(dim=3, delta=True, rotation="axis_angle"),
    ],
)
def test_actions_that_do_not_add_up_with_a_state_are_refused(action: ActionSpec) -> None:
    with pytest.raises(ConfigError, match="leave the wrapper out"):
        absolute(Reaching(action=action)).initialize()
