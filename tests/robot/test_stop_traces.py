"""After any stop no command is applied: a property of the trace of calls, for each source of stops
and each setting.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scripted_leader import ScriptedLeader

from vlagents_ray.chunking.buffer import Mode
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.commands import COMMAND, CommandInbox
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.robot import (
    Operator,
    PageOperator,
    Verdict,
    VisibleTrial,
    evaluate_on_robot,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot import Guard, LoopOptions, MotionLimits, Watchdog, run_loop
from vlagents_ray.robot.record import Recorder

HZ = 200.0
EVENT_AT = 6  # the observation in whose tick the robot is stopped
# relative actions have no rest pose
MOTION = MotionLimits(velocity=20.0, acceleration=2000.0, jerk=2e6)
REST = replace(MOTION, rest=(-0.5, -0.5))
# targets below it belong to the motion to the rest pose; the policy's are above 0
WAY_TO_REST = -0.05


class Arm:
    """A robot that records a trace of its commands, and calls a function of the test at a given
    moment.
    """

    def __init__(self) -> None:
        self.trace: list[str] = []
        self.holds: str | None = None
        self.at_rest_way = False  # whether the robot is moving to the rest pose
        self.observations = 0
        self.moment: Callable[[], bool] = lambda: False
        self.in_observe: Callable[[], None] | None = None
        self.in_apply: Callable[[], None] | None = None
        self._joints = np.zeros(2, np.float32)

    def observe(self) -> Obs:
        self.observations += 1
        self.in_observe = self._happen(self.in_observe)
        return Obs(state={"joints": self._joints.copy()})

    def apply(self, action: np.ndarray) -> None:
        self.in_apply = self._happen(self.in_apply)
        self.trace.append("apply")
        self._joints = np.array(action, np.float32)
        self.at_rest_way = self.at_rest_way or bool(action[0] < WAY_TO_REST)

    def stop(self) -> None:
        self.trace.append("stop")

    def _happen(self, event: Callable[[], None] | None) -> Callable[[], None] | None:
        if event is None or not self.moment():
            return event
        self.trace.append("EVENT")
        event()
        return None


class Policy(Agent):
    """A policy that commands positions close to the current pose, in chunks."""

    def __init__(self, *, relative: bool) -> None:
        self._contract = Contract(action=ActionSpec(dim=2, space="joint", delta=relative), chunk=4)
        self.fails: Callable[[], None] = lambda: None

    @property
    def contract(self) -> Contract:
        return self._contract

    def act(self, obs: Obs) -> Act:
        self.fails()
        return Act(np.full((4, 2), 0.001, np.float32))


@dataclass
class Run:
    """A run of the control loop, which an event stops."""

    arm: Arm
    policy: Policy
    dog: Watchdog
    inbox: CommandInbox = field(default_factory=CommandInbox)

    def command(self, do: str) -> None:
        self.inbox.receive(Act(np.zeros(2, np.float32), info={COMMAND: {"id": do, "do": do}}))


def on_a_thread(call: Callable[[], object]) -> None:
    thread = threading.Thread(target=call)
    thread.start()
    thread.join()


def raises(error: BaseException) -> Callable[[], None]:
    def fail() -> None:
        raise error

    return fail


def stopped_and_broken(run: Run) -> None:
    run.dog.trip("a person is in the way")
    raise RuntimeError("joint 3 is too hot")


def silence(run: Run) -> None:
    """Block until the watchdog has stopped the robot."""
    while "stop" not in run.arm.trace[run.arm.trace.index("EVENT") :]:
        time.sleep(0.001)


# For each source of a stop, a function that returns the event to call in `observe`.
IN_OBSERVE: dict[str, Callable[[Run], Callable[[], None]]] = {
    "a stop from afar": lambda run: lambda: run.command("stop"),
    "a pause from afar": lambda run: lambda: run.command("pause"),
    "a mark from afar": lambda run: lambda: run.command("success"),
    "the watchdog, by hand": lambda run: (
        lambda: on_a_thread(lambda: run.dog.trip("a person is in the way"))
    ),
    "the watchdog, by a silence": lambda run: lambda: silence(run),
    "a stop on another thread": lambda run: (
        lambda: on_a_thread(lambda: run.dog.control.stop("by a program"))
    ),
    "the robot's own reason": lambda run: (
        lambda: setattr(run.arm, "holds", "the wrist camera hangs")
    ),
    "Ctrl-C": lambda _: lambda: signal.raise_signal(signal.SIGINT),
    "SIGTERM of the command": lambda _: raises(SystemExit(143)),
    "an error of a sensor": lambda _: raises(OSError("the camera is unplugged")),
}
IN_APPLY: dict[str, Callable[[Run], Callable[[], None]]] = {
    "an error of the arm after a stop": lambda run: lambda: stopped_and_broken(run),
    "an error of the arm": lambda _: raises(RuntimeError("joint 3 is too hot")),
    "Ctrl-C in apply": lambda _: lambda: signal.raise_signal(signal.SIGINT),
}
IN_POLICY = {
    "an error of the policy": RuntimeError("a wrong shape"),
    "the policy's answer": PolicyFailed("NaN"),
}
SETTINGS: list[tuple[str, bool, Mode, bool, bool]] = [  # moment, relative, mode, leader, recording
    ("driven", False, "open_loop", False, True),
    ("driven", True, "open_loop", False, False),
    ("driven", False, "async", False, False),
    ("driven", True, "async", True, False),
    ("driven", False, "open_loop", True, True),
    ("on the way to rest", False, "open_loop", False, False),
    ("on the way to rest", False, "async", False, True),
]


def occurs(source: str, setting: tuple[str, bool, Mode, bool, bool]) -> bool:
    """Return whether such a stop can occur with these settings."""
    moment, _, mode, led, _ = setting
    if source == "a pause from afar":
        return not led  # by design it does not interrupt an operator
    # On the way to rest no policy is called; in the other modes the policy's error arrives at a
    # later tick.
    return source not in IN_POLICY or (moment == "driven" and mode == "open_loop" and not led)


SOURCES = [*IN_OBSERVE, *IN_APPLY, *IN_POLICY]
STOPS = [(source, setting) for source in SOURCES for setting in SETTINGS if occurs(source, setting)]


@pytest.mark.slow
@pytest.mark.parametrize(("source", "setting"), STOPS, ids=str)
def test_nothing_is_applied_after_a_stop(
    tmp_path: Path, source: str, setting: tuple[str, bool, Mode, bool, bool]
) -> None:
    moment, relative, mode, led, recorded = setting
    arm, policy = Arm(), Policy(relative=relative)
    leader = ScriptedLeader(np.full(2, 0.001, np.float32), lambda: True) if led else None
    guard = Guard(policy.contract, limits=MOTION if relative else REST, hz=HZ, soft_start_s=0.0)
    player = ChunkPlayer(
        policy, PlayerSettings(mode, deadline_s=0.0 if led else None), check=guard, override=leader
    )
    run = Run(arm, policy, Watchdog(lambda _: arm.stop(), {"loop": 0.3}))
    if moment == "driven":
        arm.moment = lambda: arm.observations >= EVENT_AT and "apply" in arm.trace
    else:
        arm.moment = lambda: arm.at_rest_way
    if source in IN_OBSERVE:
        arm.in_observe = IN_OBSERVE[source](run)
    elif source in IN_APPLY:
        arm.in_apply = IN_APPLY[source](run)
    else:

        def fails() -> None:
            if arm.moment():
                arm.trace.append("EVENT")
                raise IN_POLICY[source]

        policy.fails = fails
    with ExitStack() as stack:
        stack.enter_context(player)
        recorder = None
        if recorded:
            recorder = stack.enter_context(Recorder(tmp_path / "data", HZ, interventions=led))
        with suppress(KeyboardInterrupt, SystemExit, OSError, RuntimeError, PolicyFailed):
            run_loop(
                arm,
                player,
                hz=HZ,
                seconds=0.1,
                watchdog=run.dog,
                recorder=recorder,
                options=LoopOptions(commands=run.inbox),
            )
    require_still(arm)


def require_still(arm: Arm) -> None:
    [event] = [number for number, entry in enumerate(arm.trace) if entry == "EVENT"]
    after = arm.trace[event + 1 :]
    assert "apply" in arm.trace[:event] or arm.in_apply is None, "the robot must have moved before"
    assert "apply" not in after
    assert "stop" in after


class Person(Operator):
    """An operator who presses stop or closes the page at a given moment of the trial."""

    def __init__(self, arm: Arm, stops: Callable[[], bool]) -> None:
        self._arm, self._stops = arm, stops
        self.endings: list[str] = []

    def prepare(self, trial: VisibleTrial, observe: Callable[[], Obs]) -> bool:
        return True

    def watch(self, obs: Obs) -> None: ...

    def stops(self) -> bool:
        return self._stops()

    def judge(self, trial: VisibleTrial, ending: str) -> Verdict:
        self.endings.append(ending)
        return Verdict("failure")


MAX_STEPS = 20


def blind_trial(tmp_path: Path, arm: Arm, person: Operator, policy: Policy, mode: Mode) -> None:
    limits = tmp_path / "limits.json"
    stated = {"velocity": 20.0, "acceleration": 2000.0, "jerk": 2e6}
    with_rest = {} if policy.contract.action.relative else {"rest": [-0.5, -0.5]}
    limits.write_text(json.dumps(stated | with_rest))
    robot = {"arm": "x:Y", "hz": HZ, "limits": str(limits), "mode": mode, "silent_s": 30.0}
    tasks = {"cup": {"instruction": "lift the cup", "max_steps": MAX_STEPS}}
    config = EvalConfig.model_validate(
        {
            "policies": [{"name": "p", "url": "http://x"}],
            "suites": [{"envs": ["cup"], "episodes": 1}],
            "out": tmp_path / "out",
            "robot": robot | {"tasks": tasks},
        }
    )
    summary = evaluate_on_robot(config, person, robot=arm, agent_factory=lambda _: policy)
    [episode] = summary.results.cases[0].episodes
    assert episode.result.steps <= MAX_STEPS


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize(
    ("moment", "relative"), [("driven", False), ("driven", True), ("on the way to rest", False)]
)
@pytest.mark.parametrize("source", ["the button", "a closed page", "the robot's own reason"])
def test_nothing_is_applied_after_a_stop_of_a_blind_trial(
    tmp_path: Path, source: str, moment: str, mode: Mode, *, relative: bool
) -> None:
    arm = Arm()
    if moment == "driven":
        arm.moment = lambda: "apply" in arm.trace
    else:
        arm.moment = lambda: arm.at_rest_way
    page = PageOperator()

    def stops() -> bool:
        if source == "the robot's own reason" or not arm.moment():
            page._asked_at = time.monotonic()  # like an open page, which sends requests
            return page.stops()
        if "EVENT" not in arm.trace:
            arm.trace.append("EVENT")
        if source == "the button":
            page._answer = {"do": "stop"}
        else:
            page._asked_at = 0.0
        return page.stops()

    if source == "the robot's own reason":
        arm.in_observe = lambda: setattr(arm, "holds", "the wrist camera hangs")
    person = Person(arm, stops)
    blind_trial(tmp_path, arm, person, Policy(relative=relative), mode)
    require_still(arm)
    pressed = source != "the robot's own reason" and moment == "driven"
    assert person.endings == ["stopped by the operator" if pressed else "the trial is over"]


def test_a_trial_counts_no_step_of_the_way_to_rest(tmp_path: Path) -> None:
    arm = Arm()
    blind_trial(tmp_path, arm, Person(arm, lambda: False), Policy(relative=False), "open_loop")
    assert arm.trace.count("apply") > MAX_STEPS, "the robot moved to its rest pose"


class Numbered(Agent):
    """A policy with chunks of three rows that begin at the current pose. The second column is the
    chunk's number.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.chunks = 0
        # events that happen while a chunk is computed
        self.begins: dict[int, Callable[[], object]] = {}

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2, space="joint", delta=False), chunk=3)

    def act(self, obs: Obs) -> Act:
        self.chunks += 1
        self.begins.pop(self.chunks, lambda: None)()
        rows = np.full((3, 2), self.chunks, np.float32)
        rows[:, 0] = obs.state["joints"][0] + 0.001 * np.arange(3)
        return Act(rows)


@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize("chunk", [1, 2, 3])
def test_a_stop_in_the_tick_in_which_a_chunk_begins_drops_that_chunk(
    mode: Mode, chunk: int
) -> None:
    arm = Arm()
    applied: list[float] = []
    apply = arm.apply
    arm.apply = lambda action: (applied.append(float(action[1])), apply(action))  # type: ignore[method-assign,assign]
    policy = Numbered(arm)
    dog = Watchdog(lambda _: arm.stop(), {"loop": 60.0})
    policy.begins[chunk] = lambda: on_a_thread(lambda: dog.trip("a person is in the way"))
    stopped_at: list[int] = []
    before: int | None = None  # number of commands before the restart

    def over() -> bool:  # true some commands later; a busy machine may begin the chunk late
        nonlocal before
        if dog.control.stopped and not stopped_at:
            stopped_at.append(arm.observations)
        if stopped_at and arm.observations == stopped_at[0] + 3:
            before = len(applied)
            assert dog.restart()
        return before is not None and len(applied) > before + 8

    with ChunkPlayer(policy, PlayerSettings(mode)) as player:
        run_loop(arm, player, hz=HZ, watchdog=dog, until=over)
    assert before is not None
    stop = arm.trace.index("stop")
    if arm.trace[:stop].count("apply") < before:  # the command at that moment ended after the stop
        assert arm.trace[stop : stop + 3] == ["stop", "apply", "stop"]
        assert arm.trace[: stop + 2].count("apply") == before
    assert not applied[:before] or max(applied[:before]) < chunk
    assert min(applied[before:]) > chunk, (
        "a chunk from before the stop must not be executed after it"
    )


def test_a_stop_of_one_robot_leaves_the_loop_of_another_running() -> None:
    arms = [Arm(), Arm()]
    dogs = [Watchdog(lambda _, arm=arm: arm.stop(), {"loop": 60.0}) for arm in arms]  # type: ignore[misc]
    at: list[int] = []

    def over() -> bool:
        if arms[1].observations > EVENT_AT and not at:
            dogs[0].trip("a person is in the way")
            at.append(arms[1].trace.count("apply"))
        return bool(at) and arms[1].trace.count("apply") > at[0] + 10

    def drive(number: int) -> None:
        with ChunkPlayer(Policy(relative=True), PlayerSettings("async")) as player:
            run_loop(
                arms[number],
                player,
                hz=HZ,
                watchdog=dogs[number],
                until=ends[number],
                options=LoopOptions(restart="manual"),
            )

    ended = threading.Event()
    ends = [ended.is_set, over]
    other = threading.Thread(target=drive, args=(0,))
    other.start()
    while "apply" not in arms[0].trace:
        time.sleep(0.001)
    drive(1)
    ended.set()
    other.join()
    assert "apply" not in arms[0].trace[arms[0].trace.index("stop") :]
    assert arms[1].trace.index("stop") == len(arms[1].trace) - 1, "only at the end"


def test_after_a_lost_leader_and_a_stop_a_restart_alone_moves_nothing() -> None:
    arm, policy = Arm(), Policy(relative=True)
    lost: list[bool] = []

    def wants() -> bool:
        if lost:
            raise OSError("the SpaceMouse is unplugged")
        return True

    leader = ScriptedLeader(np.full(2, 0.001, np.float32), wants)
    dog = Watchdog(lambda _: arm.stop(), {"loop": 60.0})
    resumed: list[int] = []

    def over() -> bool:
        if arm.observations == EVENT_AT:
            lost.append(True)
        elif arm.observations == EVENT_AT + 3:
            dog.trip("a person is in the way")
        elif arm.observations == EVENT_AT + 6:
            assert dog.restart()
        elif arm.observations == EVENT_AT + 9:
            assert "apply" not in arm.trace[arm.trace.index("stop") :], (
                "the pause of the lost leader must last"
            )
            lost.clear()
            leader.wants = lambda: False
            dog.control.resume()
            resumed.append(len(arm.trace))
        return arm.observations > EVENT_AT + 30

    with ChunkPlayer(policy, PlayerSettings("async"), override=leader) as player:
        run_loop(
            arm, player, hz=HZ, watchdog=dog, until=over, options=LoopOptions(restart="manual")
        )
    assert "apply" in arm.trace[resumed[0] :]
