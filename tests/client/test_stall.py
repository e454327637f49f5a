"""A policy that stalls, and the robot's position afterwards. Time is counted in ticks; no clock is
used.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from eval_fakes import wait_for
from in_process_replicas import Replicas

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    Contract,
    Obs,
    PlayerSettings,
    StateSpec,
)
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.robot import Guard

HZ = 50
ROWS = 20
ANSWER = 5  # number of ticks until an answer
STALLS = [30, 150]  # ticks; 0.6 s and 3 s
GOAL, GAIN = 3.0, 0.004  # goal, and the share of the distance to it that is travelled per tick


class Approaching(Agent):
    """A policy that plans the path from the observed position to the goal. Each row is slightly
    shorter than the row before.
    """

    def __init__(self, delta: bool) -> None:
        self.delta = delta

    @property
    def contract(self) -> Contract:
        return Contract(
            state={"joints": StateSpec(1)}, action=ActionSpec(dim=1, delta=self.delta), chunk=ROWS
        )

    def act(self, obs: Obs) -> Act:
        left = (GOAL - float(obs.state["joints"][0])) * (1 - GAIN) ** np.arange(ROWS + 1)
        return Act(
            (left[:-1] - left[1:] if self.delta else GOAL - left[1:]).astype(np.float32)[
                :, np.newaxis
            ]
        )


class Delayed(Agent):
    """A layer between a player and its policy, whose answers a test releases."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.asked = 0
        self.called, self.gate = threading.Semaphore(0), threading.Semaphore(0)

    @property
    def contract(self) -> Contract | None:
        return self.agent.contract

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return self.agent.reset(obs, instruction)

    def act(self, obs: Obs) -> Act:
        self.asked += 1
        if self.asked > 1:  # `reset` waits for the first answer
            self.called.release()
            assert self.gate.acquire(timeout=60)
        return self.agent.act(obs)

    def close(self) -> None:
        self.agent.close()


class Run(NamedTuple):
    at: np.ndarray  # (T,) position of the robot at each tick
    moved: np.ndarray  # (T,) distance moved at each tick
    fresh: int  # tick at which the stalled answer arrived


def drive(
    agent: Agent,
    delta: bool,
    stall: int,
    check: Guard | None,
    stalled: Callable[[], None] = lambda: None,
) -> Run:
    """Drive a robot that follows its commands exactly. The sixth answer takes `stall` ticks, and
    all others `ANSWER`.
    """
    delayed = Delayed(agent)
    at: list[float] = []
    moved: list[float] = []
    position, fresh = 0.0, 0
    due: int | None = None  # tick at which the current request is answered
    with ChunkPlayer(delayed, PlayerSettings(mode="async"), check=check) as player:
        see = lambda: Obs(state={"joints": np.array([position], np.float32)})  # noqa: E731
        player.reset(see(), "go")
        caller = player._caller
        assert caller is not None
        for tick in range(60 + 2 * stall):
            if tick == due:
                delayed.gate.release()
                wait_for(lambda: not caller.busy, every_s=0.001)
                due, fresh = None, tick if delayed.asked == 6 else fresh
            act = player.act(see())
            if due is None and not caller.idle:
                assert delayed.called.acquire(timeout=60)
                due = tick + (stall if delayed.asked == 6 else ANSWER)
                if delayed.asked == 6:
                    stalled()
            step = float(act.action[0]) - (0.0 if delta else position)
            at.append(position)
            moved.append(step)
            position += step
        delayed.gate.release(1000)
    return Run(np.array(at), np.array(moved), fresh)


def evaluated(agent: Agent, delta: bool, stall: int) -> Run:
    """Run the same in a real-time evaluation, which sends its next request when part of the chunk
    is left.
    """
    contract = Contract(action=ActionSpec(dim=1, delta=delta), control_hz=HZ)
    player = ChunkExecutor(
        ROWS - ANSWER, ClockConfig(latency=0.1, mode="async", neutral=[0.0]), contract
    )
    at: list[float] = []
    moved: list[float] = []
    position, fresh = 0.0, 0
    for answer in range(20):
        rows = agent.act(Obs(state={"joints": np.array([position], np.float32)})).action
        ticks = stall if answer == 6 else ANSWER
        fresh = len(at) + stall if answer == 6 else fresh
        for tick in player.ticks(rows, ticks / HZ):
            step = float(tick.action[0]) - (0.0 if delta else position)
            at.append(position)
            moved.append(step)
            position += step
    return Run(np.array(at), np.array(moved), fresh)


def check_recovery(run: Run, stall: int) -> None:
    wanted = GAIN * (GOAL - run.at)  # the policy's action at the robot's position
    still = np.abs(run.moved) < 1e-5
    assert still.sum() >= stall - ROWS  # the robot did stall
    # Each action belongs to the robot's position at that tick: no jump, and no part left out.
    assert run.moved[~still] == pytest.approx(wanted[~still], rel=1e-2)
    normal = np.abs(run.moved[: run.fresh - stall]).max()
    assert np.abs(run.moved[run.fresh :]).max() <= 1.5 * normal
    resumed = run.fresh + int(np.argmin(still[run.fresh :]))
    assert not still[resumed]
    assert (resumed - run.fresh) / HZ <= 0.5
    assert still[resumed:].mean() < 0.1  # and the robot continues to move


@pytest.mark.slow
@pytest.mark.parametrize("killed", [False, True])
@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("stall", STALLS)
def test_after_a_stall_the_robot_goes_on_from_where_it_is(
    stall: int, *, delta: bool, guarded: bool, killed: bool
) -> None:
    """This holds if the policy answers late, and if its replica was killed."""
    agent: Agent = Approaching(delta)
    guard = Guard(agent.contract, max_step=1.5 * GAIN * GOAL) if guarded else None
    if not killed:
        check_recovery(drive(agent, delta, stall, guard), stall)
        return
    with contextlib.closing(Replicas([agent, Approaching(delta)])) as served:
        check_recovery(
            drive(served.agent(), delta, stall, guard, lambda: served.dead.add(0)), stall
        )


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("stall", STALLS)
def test_a_real_time_evaluation_goes_on_in_the_same_way(stall: int, delta: bool) -> None:
    check_recovery(evaluated(Approaching(delta), delta, stall), stall)
