"""PushT by its protocol: the recorded values, and when an episode is solved."""

from __future__ import annotations

import math
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from experts.pusht import PushTExpert
from in_process_episode import Always, play

from vlagents_ray.envs import EvalEnv, make_env
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Act, Obs

pytest.importorskip("gym_pusht")  # the import registers the environment
pytestmark = pytest.mark.sim

NAME = "pusht"
# The positions of agent and block, in the form of `reset_to_state`; the block covers 84.6 % of the
# target.
BESIDE = [333.0, 236.0, 230.0, 239.0, math.pi / 4]
PUSHING = Always(270.0, 251.0)  # a target that pushes the block to the left


@pytest.fixture(scope="module")
def pusht() -> Iterator[EvalEnv]:
    with make_env(NAME) as env:
        yield env


def test_the_protocol_is_recorded_with_what_deviates_from_it(pusht: EvalEnv) -> None:
    protocol = pusht.describe()["protocol"]
    assert (protocol["name"], protocol["max_steps"], protocol["control_hz"]) == ("PushT", 300, 10.0)
    assert protocol["deviations"] == []
    with make_env(NAME, max_steps=50) as shorter:
        assert shorter.describe()["protocol"]["deviations"] == [
            "max_steps: 50, the protocol says 300"
        ]


def test_the_protocols_constants_are_the_simulators() -> None:
    simulator = gymnasium.make("gym_pusht/PushT-v0", disable_env_checker=True)
    assert simulator.spec is not None
    assert simulator.spec.max_episode_steps == 300
    assert simulator.unwrapped.control_hz == 10  # type: ignore[attr-defined]
    assert simulator.unwrapped.success_threshold == 0.95  # type: ignore[attr-defined]
    simulator.close()


def test_a_block_pushed_onto_the_target_is_a_success_and_ends_the_episode(pusht: EvalEnv) -> None:
    result = play(pusht, NAME, PUSHING, reset_to_state=BESIDE)
    assert (result.success_once, result.success_at_end, result.ending) == (True, True, "terminated")
    assert result.steps < 20


def test_success_wants_more_than_95_percent_of_the_target_covered(pusht: EvalEnv) -> None:
    pusht.reset(seed=0, options={"reset_to_state": BESIDE})
    covered = []
    for _ in range(10):
        *_, terminated, _, info = pusht.step(Act(PUSHING.action))
        covered.append((info["coverage"] > 0.95, info["success"], terminated))
        if terminated:
            break
    assert (False, False, False) in covered
    assert covered[-1] == (True, True, True)


def test_the_expert_solves_random_beginnings_and_holding_still_does_not() -> None:
    with make_env("pusht/keypoints") as env:  # the expert does not use the image
        for seed in (14, 48):  # seeds that are solved soon
            solved = play(env, "pusht/keypoints", "experts.pusht:PushTExpert", seed=seed)
            assert (solved.success_once, solved.ending) == (True, "terminated")
        first, _ = env.reset(seed=3)
        still = play(env, "pusht/keypoints", Always(*first.state["agent_pos"]), seed=3)
        assert (still.success_once, still.steps) == (False, 300)


def test_a_block_that_is_not_where_the_expert_expected_it_makes_it_plan_again(
    pusht: EvalEnv,
) -> None:
    (before, _), (elsewhere, _) = pusht.reset(seed=0), pusht.reset(seed=1)
    interrupted, fresh = PushTExpert("pusht"), PushTExpert("pusht")
    interrupted.act(before)
    assert np.array_equal(interrupted.act(elsewhere).action, fresh.act(elsewhere).action)


def test_with_a_block_out_of_reach_the_expert_holds_still() -> None:
    seen = Obs(info={"sim_state": np.array([100.0, 200.0, 0.0, 0.0, 900.0, 900.0, 0.0])})
    assert PushTExpert("pusht").act(seen).action.tolist() == [100.0, 200.0]


def test_without_the_simulators_state_the_expert_says_what_it_wants() -> None:
    with pytest.raises(InvalidObservation, match=r"sim_state.*\(7,\).*pusht/keypoints.*NoneType"):
        PushTExpert("pusht/keypoints").reset(Obs(), "")
