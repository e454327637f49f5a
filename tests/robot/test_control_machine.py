"""Stops, pauses, take-overs and remote commands in any order: the robot moves only when this is
allowed.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from eval_fakes import SimulatedTime
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from in_process_replicas import Replicas
from many import many

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.commands import COMMAND, CommandInbox
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import OF_THE_LOOP, SAFE
from vlagents_ray.robot import Guard, LoopOptions, Watchdog, run_loop

HUMANS, WILD = 0.5, 9.0  # values of actions; the policy's are below 0.3
GARBAGE = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(allow_nan=True),
    st.text(max_size=3),
    st.just(np.full(2, 9.0, np.float32)),
    st.just({"a": [1]}),
    st.just(float("nan")),
    st.just(-1e9),
)
ENDING_S = 30.0  # time limit after which a loop that does not end counts as failed


def event(**drawn: Any) -> Callable[[Callable[..., None]], Any]:
    """Make a Hypothesis rule from an event between two ticks, followed by up to two ticks."""

    def decorate(function: Callable[..., None]) -> Any:
        def happen(machine: Machine, after: int, **values: Any) -> None:
            function(machine, **values)
            machine.tick(after)

        happen.__name__ = function.__name__
        return rule(after=st.integers(0, 2), **drawn)(happen)

    return decorate


class Machine(RuleBasedStateMachine):
    """A control loop that runs a tick when a rule requests it, and a model of what may move the
    robot.
    """

    def __init__(self) -> None:
        super().__init__()
        self.commanded_stop = self.paused = self.ticked = False
        self.barked: set[str] = set()
        self.held = self.engaged = False  # state of the human's device, now and at the last poll
        self.wild = self.broken = False
        self.info: dict[str, Any] = {}
        self.from_afar: list[dict[str, str]] = []
        self.passed: list[bytes] = []
        # Number of applied actions in a run that came from the human, without the safe actions that
        # replaced rejected ones.
        self.humans = 0
        self.wrong: list[str] = []
        self.thread: threading.Thread | None = None
        self.ready, self.go = threading.Semaphore(0), threading.Semaphore(0)
        self.ending = False
        self._open = contextlib.ExitStack()
        self._open.enter_context(patch("vlagents_ray.robot.pacing.time", SimulatedTime()))
        self._open.enter_context(
            patch("vlagents_ray.robot.loop.undisturbed", lambda **_: contextlib.nullcontext([]))
        )

    @initialize(
        simulated=st.booleans(),
        options=st.sampled_from(
            [{"mode": "open_loop"}, {"mode": "open_loop", "execute": 1}, {"mode": "ensemble"}]
        ),
        played=st.booleans(),
    )
    def build(self, *, simulated: bool, options: dict[str, Any], played: bool) -> None:
        """Build a robot with a chunk player and its leader, or with a policy that returns single
        actions.
        """
        machine = self

        class Passing(Guard):
            def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
                accepted = super().__call__(action, last)
                machine.passed.append(accepted.tobytes())
                return accepted

        class Policy(Agent):
            contract = Contract(action=ActionSpec(dim=2, delta=False, low=-1.0, high=1.0))
            acts = 0

            def act(self, obs: Obs) -> Act:
                self.acts += 1
                row = np.full(2, 0.001 * (self.acts % 300), np.float32)
                act = Act(
                    np.tile(row, (3, 1)) if played else row,
                    info=dict(machine.info) if played else {},
                )
                if machine.wild and played:
                    act.action[:] = WILD
                if machine.from_afar:
                    act.info[COMMAND] = machine.from_afar.pop(0)
                    machine.paused |= act.info[COMMAND]["do"] == "pause"
                    machine.commanded_stop |= act.info[COMMAND]["do"] == "stop"
                machine.inbox.receive(act)
                return act

        class Leader:
            def engaged(self) -> bool:
                if machine.broken:
                    machine.paused, machine.engaged = True, False
                    raise OSError("unplugged")
                if machine.held and not machine.engaged:
                    machine.paused = False
                machine.engaged = machine.held
                return machine.engaged

            def action(self, obs: Obs) -> np.ndarray:
                return np.full(2, WILD if machine.wild else HUMANS, np.float32)

        self.inbox, self.played, self.simulated = CommandInbox(), played, simulated
        self.watchdog = Watchdog(lambda _: None, {"server": 1e6, "loop": 1e6, "camera": 1e6})
        self.guard = Passing(Policy.contract)
        self.agent: Agent = Policy()
        if played:
            self.agent = ChunkPlayer(
                Policy(),
                PlayerSettings(safe="hold", **options),
                override=Leader(),
                check=self.guard,
            )
            self.watchdog.share(self.agent.control)
        self.control = self.watchdog.control

    # The robot.
    def observe(self) -> Obs:
        if self.failing:
            self.failing = False
            raise RuntimeError("a sensor")
        if self.simulated and self.ticked:
            self.barked.discard("server")  # the last tick was a sign of life of the server
        self.ticked = True
        return Obs()

    failing = False

    def apply(self, action: np.ndarray) -> None:
        """Compare an action with the model."""
        value = float(action[0])
        humans = value == HUMANS
        # The guard rejects a wild action, and a safe action replaces it.
        accepted = self.engaged and not self.wild
        self.humans += accepted
        if self.commanded_stop or self.barked:
            self.wrong.append(f"{value} after a stop without a restart")
        if self.paused and not self.engaged:
            self.wrong.append(f"{value} in a pause")
        if not self.engaged and humans and self.last != HUMANS:
            self.wrong.append("the human's action, who has let go")
        if accepted and not humans:
            self.wrong.append(f"{value} in place of the human's action, which the guard accepts")
        if self.engaged and not humans and value != self.last:
            self.wrong.append(f"{value}, as the policy took the robot from the human")
        if action.tobytes() not in self.passed:
            self.wrong.append(f"{value}, which the guard has not passed")
        self.last = value

    last = 0.0

    def stop(self) -> None: ...

    def _run(self) -> None:
        def gate() -> bool:
            self.ready.release()
            self.go.acquire()
            return self.ending

        self.humans, interventions = 0, 0
        try:
            report = run_loop(
                self,
                self.agent,
                hz=50,
                watchdog=self.watchdog,
                until=gate,
                options=LoopOptions(
                    guard=None if self.played else self.guard,
                    restart="auto" if self.simulated else "manual",
                    commands=self.inbox,
                ),
            )
            interventions = report.interventions
            if interventions != self.humans:
                self.wrong.append(
                    f"{interventions} interventions, of which {self.humans} are the human's"
                )
        except InvalidAction:
            # A wild action came before the first accepted one. Then there is nothing to hold, so
            # the run ends with a stop.
            pass
        except RuntimeError as error:
            if str(error) != "a sensor":
                self.wrong.append(repr(error))
        except Exception as error:  # noqa: BLE001 - a loop that ends by itself would hide all later events
            self.wrong.append(repr(error))
        self.over = True
        self.ready.release()

    over = True

    def _begin(self) -> None:
        self.ending = self.over = False
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        assert self.ready.acquire(timeout=ENDING_S)

    def tick(self, times: int) -> None:
        """Run ticks, in another run if the last one has ended."""
        for _ in range(times):
            if self.over:
                self._begin()
            if not self.over:
                self.go.release()
                assert self.ready.acquire(timeout=ENDING_S)

    @event()
    def end_the_run(self) -> None:
        if not self.over:
            self.ending = True
            self.tick(1)
            assert self.over

    @event()
    def fail(self) -> None:
        self.failing = True

    @event()
    def pause(self) -> None:
        self.control.pause()
        self.paused = True

    @event()
    def resume(self) -> None:
        self.control.resume()
        self.paused = False

    @event(source=st.sampled_from(["server", "camera", "trip", "own program"]))
    def stop_at_the_robot(self, source: str) -> None:
        if source in ("trip", "own program"):
            (self.watchdog.trip if source == "trip" else self.control.stop)(
                "a person is in the way"
            )
            self.commanded_stop = True
            return
        self.control.stop(f"{source}: silent", silent=source)
        self.barked.add(source)
        self.ticked = False

    @event()
    def end_of_the_silence(self) -> None:
        self.watchdog.heard("camera")
        if self.simulated:
            self.barked.discard("camera")

    @event()
    def restart(self) -> None:
        silent = bool(self.control.silent)
        assert self.watchdog.restart() is not silent
        if not silent:
            self.commanded_stop = False
            self.barked.clear()

    @event(held=st.booleans())
    def set_everything_going(self, *, held: bool) -> None:
        self.wild = self.broken = self.failing = False
        self.held = held
        self.end_of_the_silence_of_all()
        assert self.watchdog.restart()
        self.control.resume()
        self.commanded_stop = self.paused = False
        self.barked.clear()
        self.tick(2)

    @event(do=st.sampled_from(["pause", "stop"]), held=st.booleans())
    def hold_from_afar_what_moves(self, do: str, *, held: bool) -> None:
        self.set_everything_going(after=0, held=held)
        self.from_afar = [{"id": do, "do": do}]
        self.tick(3)

    def end_of_the_silence_of_all(self) -> None:
        for source in self.control.silent:
            self.watchdog.heard(source)

    @event()
    def mark(self) -> None:
        self.control.mark("success")

    @event(held=st.booleans())
    def take_over_or_release(self, *, held: bool) -> None:
        self.held = held

    @event(broken=st.booleans())
    def break_the_device(self, *, broken: bool) -> None:
        self.broken = broken and self.played

    @event(wild=st.booleans())
    def be_wild(self, *, wild: bool) -> None:
        self.wild = wild

    @event(
        do=st.sampled_from(
            [
                "pause",
                "stop",
                "stop",
                "success",
                "failure",
                "resume",
                "instruct",
                "restart",
                "begin",
                "move",
            ]
        )
    )
    def command_from_afar(self, do: str) -> None:
        self.from_afar.append({"id": do, "do": do, "text": "fold"})

    @event(info=st.dictionaries(st.sampled_from(OF_THE_LOOP), GARBAGE, max_size=4))
    def state_garbage(self, info: dict[str, Any]) -> None:
        self.info = info

    @invariant()
    def nothing_moved_that_may_not(self) -> None:
        assert self.wrong == []

    def teardown(self) -> None:
        self.ending = True
        if not self.over:
            self.tick(1)
        if self.thread is not None:
            self.thread.join(ENDING_S)
        self._open.close()
        assert self.wrong == []


@pytest.mark.slow
def test_nothing_moves_after_a_stop_or_in_a_pause_or_past_the_guard_in_any_order() -> None:
    run_state_machine_as_test(
        Machine, settings=settings(max_examples=many(200), stateful_step_count=50, deadline=None)
    )


class Loop(Agent):
    """A policy whose answers have a given info."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))

    def __init__(self, info: dict[str, Any]) -> None:
        self._info = info

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros((4, 2), np.float32), info=dict(self._info))


def test_no_answer_of_a_server_has_a_name_of_the_loop() -> None:
    replicas = Replicas([Loop({**dict.fromkeys(OF_THE_LOOP, 1.0), "other": 1})])
    with replicas.agent() as agent:
        agent.reset(Obs())
        answers = [agent.act(Obs()), *agent.act_batch([Obs()], [agent])]
    replicas.close()
    for act in answers:
        assert isinstance(act, Act)
        assert not set(OF_THE_LOOP) & set(act.info)
        assert act.info["other"] == 1


@pytest.mark.parametrize("name", OF_THE_LOOP)
def test_an_answer_with_a_name_of_the_loop_changes_nothing(name: str) -> None:
    seen = []
    for value in (
        None,
        True,
        "fine",
        float("nan"),
        -1e9,
        10**6,
        np.full(2, 9.0, np.float32),
        [1],
        {"row": 1},
    ):
        for info in ({}, {name: value, "other": 1}):
            with ChunkPlayer(Loop(info)) as player:
                player.initialize()
                player.reset(Obs())
                acts = [player.act(Obs()) for _ in range(5)]
            kept = [{key: act.info[key] for key in OF_THE_LOOP if key in act.info} for act in acts]
            for one in kept:
                del one["age_ms"]
                one["planned"] = one["planned"].tolist()
            seen.append(kept)
            assert all(act.info.get("other") == info.get("other") for act in acts)
            assert not any(SAFE in act.info for act in acts)
    assert all(one == seen[0] for one in seen)
