"""The control loop: its schedule, what it does when things go wrong, and what it reports."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from vlagents_ray import Act, ActionSpec, Agent, CameraSpec, ConfigError, Contract, Obs, PolicyFailed, StateSpec
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.cli.robot import _restarting as restarting
from vlagents_ray.cli.robot import main
from vlagents_ray.errors import InvalidAction
from vlagents_ray.robot import Guard, Watchdog, run_loop
from vlagents_ray.robot.loop import ROBOT, import_class
from vlagents_ray.robot.pacing import Pacer, jitter, undisturbed
from vlagents_ray.robot.simulated import SimulatedRobot

HZ = 200.0


class Going(Agent):
    """Absolute targets that grow by 0.01 a tick."""

    contract = Contract(action=ActionSpec(dim=2, delta=False, low=-1.0, high=1.0))

    def __init__(self, *, wrong_at: int | None = None, done_at: int | None = None, slow_at: int | None = None) -> None:
        self.wrong_at, self.done_at, self.slow_at = wrong_at, done_at, slow_at
        self.instruction: str | None = None
        self.tick = 0

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.instruction, self.tick = instruction, 0
        return {}

    def act(self, obs: Obs) -> Act:
        assert obs.info["captured_at"] <= time.time()
        tick, self.tick = self.tick, self.tick + 1
        if tick == self.slow_at:
            time.sleep(5.5 / HZ)
        value = 7.0 if tick == self.wrong_at else 0.01 * tick
        return Act(np.full(2, value, np.float32), done=tick == self.done_at)


def set_limit(watchdog: Watchdog, name: str, silent_s: float) -> None:
    """Of a watchdog that runs. A busy machine keeps a loop from a short one's sign of life until it is wanted."""
    with watchdog._changed:
        watchdog._limits[name] = silent_s
        watchdog._changed.notify_all()


class Hanging(Going):
    """Returns its fourth action once the watchdog has stopped the robot."""

    def __init__(self) -> None:
        super().__init__(done_at=5)
        self.stopped = threading.Event()
        self.watchdog = Watchdog(self._stop, {"loop": 60.0, "server": 60.0})

    def _stop(self, _: str) -> None:
        self.watchdog._limits["loop"] = 60.0
        self.stopped.set()

    def act(self, obs: Obs) -> Act:
        if self.tick == 3:
            set_limit(self.watchdog, "loop", 0.1)
            assert self.stopped.wait(30)
        return super().act(obs)


class Watched(SimulatedRobot):
    """Keeps what it was commanded."""

    def __init__(self, contract: Contract | None = None) -> None:
        super().__init__(contract)
        self.commanded: list[float] = []
        self.stops = 0

    def apply(self, action: np.ndarray) -> None:
        super().apply(action)
        self.commanded.append(round(float(action[0]), 4))

    def stop(self) -> None:
        super().stop()
        self.stops += 1


def test_a_robot_that_must_not_move_is_stopped_and_goes_on_by_itself_with_a_new_plan() -> None:
    robot = Watched(Going.contract)
    asked: list[int] = []

    class Asked(Going):
        def act(self, obs: Obs) -> Act:
            asked.append(len(robot.commanded))
            return Act(np.tile(super().act(obs).action, (50, 1)))

    def until() -> bool:  # before each tick
        ticks.append(len(ticks))
        robot.holds = "the camera hangs" if 5 <= len(ticks) < 15 else None
        return len(ticks) > 20

    ticks: list[int] = []
    report = run_loop(robot, ChunkPlayer(Asked()), hz=HZ, until=until)
    assert (report.safe, report.reasons) == ({"robot": 10}, {"robot": "the camera hangs"})
    assert robot.stops == 2  # as it began to hold, and at the end
    assert len(robot.commanded) == 10
    assert asked[0] == 0
    assert len(asked) >= 2, "the plan from before was dropped"


def test_the_schedule_does_not_drift_and_says_what_it_missed() -> None:
    pacer = Pacer(HZ)
    begun = time.perf_counter()
    ticks = [pacer.wait() for _ in range(10)]
    time.sleep(4 / HZ)
    ticks += [pacer.wait() for _ in range(10)]
    assert ticks == sorted(set(ticks))
    assert pacer.missed == ticks[-1] + 1 - len(ticks) >= 3
    assert time.perf_counter() - begun >= ticks[-1] / HZ
    assert min(pacer.late_s) >= 0


def test_jitter_counts_a_missed_tick_as_one_that_was_late() -> None:
    told = jitter([0.0001, 0.0001, 0.003], missed=1)
    assert told["on_time"] == 0.5
    assert told["p50_ms"] == pytest.approx(0.1)
    assert told["max_ms"] == pytest.approx(3.0)


@pytest.mark.parametrize("frozen", [False, True])
def test_the_process_is_left_as_it_was(*, frozen: bool) -> None:
    def settings() -> tuple[object, ...]:
        nice = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        return gc.isenabled(), gc.get_freeze_count(), sys.getswitchinterval(), nice

    (gc.freeze if frozen else gc.unfreeze)()
    try:
        before = settings()
        heap = [[] for _ in range(100_000)]
        with undisturbed() as done:
            assert not gc.isenabled()
            assert done
            assert len(gc.get_objects()) < len(heap), "a collection within the loop would go through all of them"
        after = settings()
        assert (after[0], *after[2:]) == (before[0], *before[2:])
        assert (gc.get_freeze_count() >= before[1]) if frozen else (gc.get_freeze_count() == 0)
    finally:
        gc.freeze()  # as conftest.py has it


@pytest.mark.parametrize("real_time", [False, True])
def test_where_threads_have_no_priorities_the_loop_does_without(
    monkeypatch: pytest.MonkeyPatch, *, real_time: bool
) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delattr(os, "sched_getscheduler")
    monkeypatch.setattr(os, "getpriority", lambda *_: os.kill(2**22 + 1, 0))  # no such process
    with undisturbed(real_time=real_time) as done:
        assert "no priority (only on Linux)" in done


def test_a_robot_is_driven_for_as_long_as_was_said_and_then_stopped() -> None:
    robot, agent = Watched(Going.contract), Going()
    report = run_loop(robot, agent, hz=HZ, seconds=0.2, instruction="go")
    assert report.jitter["ticks"] + report.jitter["missed"] == 40
    assert robot.commanded == [round(0.01 * i, 4) for i in range(int(report.jitter["ticks"]))]
    assert (robot.stops, agent.instruction, report.safe_ticks) == (1, "go", 0)


def test_a_slow_tick_costs_the_ticks_that_it_covers_and_no_others() -> None:
    robot = Watched(Going.contract)
    report = run_loop(robot, Going(slow_at=5), hz=HZ, seconds=0.3)
    assert report.jitter["missed"] >= 4  # the sixth begins late, but in its time
    assert report.jitter["ticks"] + report.jitter["missed"] == 60


def test_ticks_after_the_end_are_not_counted_as_missed() -> None:
    report = run_loop(Watched(Going.contract), Going(slow_at=9), hz=HZ, seconds=10 / HZ)
    assert report.jitter["ticks"] + report.jitter["missed"] == 10


def test_the_loop_ends_when_the_policy_is_done_or_the_caller_says_so() -> None:
    robot = Watched(Going.contract)
    report = run_loop(robot, Going(done_at=7), hz=HZ)
    assert report.done
    assert len(robot.commanded) == 8
    report = run_loop(robot, Going(), hz=HZ, until=lambda: len(robot.commanded) >= 12)
    assert not report.done
    assert len(robot.commanded) == 12


def test_an_action_out_of_bounds_never_reaches_the_robot_which_is_stopped() -> None:
    robot = Watched(Going.contract)
    with pytest.raises(InvalidAction, match="above the limit 1"):
        run_loop(robot, Going(wrong_at=3), hz=HZ, seconds=1)
    assert robot.commanded == [0, 0.01, 0.02]
    assert robot.stops == 1


def test_with_a_player_the_loop_goes_on_with_a_safe_action() -> None:
    robot = Watched(Going.contract)
    player = ChunkPlayer(Going(wrong_at=3), PlayerSettings(deadline_s=30.0), check=Guard(Going.contract))
    report = run_loop(robot, player, hz=HZ, until=lambda: len(robot.commanded) >= 6)
    player.close()
    assert robot.commanded == [0, 0.01, 0.02, 0.02, 0.04, 0.05]
    assert report.safe_ticks == 1


def test_the_loop_has_no_other_guard_than_its_player() -> None:
    class Bounded(Going):
        contract = Contract(action=ActionSpec(dim=2, delta=False))

    robot, guard = Watched(Bounded.contract), Guard(high=0.025)
    player = ChunkPlayer(Bounded(), PlayerSettings(deadline_s=30.0, safe=np.full(2, 9.0)), check=guard)
    report = run_loop(robot, player, hz=HZ, until=lambda: len(robot.commanded) >= 6)
    assert robot.commanded == [0, 0.01, 0.02, 0.02, 0.02, 0.02]  # neither what is planned nor the 9
    assert report.safe_ticks == 3
    run_loop(robot, player, hz=HZ, seconds=0.05, guard=guard)
    with pytest.raises(ConfigError, match="one of them"):
        run_loop(robot, player, hz=HZ, guard=Guard(high=0.025))
    player.close()


def test_a_safe_action_without_any_guard_passes_the_contracts_bounds() -> None:
    robot = Watched(Going.contract)
    player = ChunkPlayer(Going(wrong_at=3), PlayerSettings(deadline_s=30.0, safe=np.full(2, 9.0)))
    with pytest.raises(InvalidAction, match="above the limit 1"):
        run_loop(robot, player, hz=HZ, seconds=1)
    player.close()
    assert max(robot.commanded) < 0.03
    assert robot.stops == 1


def test_a_chunk_needs_a_player() -> None:
    class Chunks(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.zeros((5, 7), np.float32))

    with pytest.raises(InvalidAction, match="ChunkPlayer"):
        run_loop(Watched(), Chunks(), hz=HZ, seconds=1)


def test_a_robot_is_stopped_when_the_reset_fails() -> None:
    class Refusing(Agent):
        def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
            raise PolicyFailed("no weights")

    robot = Watched()
    with pytest.raises(PolicyFailed):
        run_loop(robot, Refusing(), hz=HZ)
    assert robot.stops == 1


def test_a_hanging_loop_is_noticed_by_the_watchdog() -> None:
    agent = Hanging()
    report = run_loop(Watched(Going.contract), agent, hz=HZ, watchdog=agent.watchdog)
    assert [bark.partition(":")[0] for bark in report.barks] == ["loop"]


def test_a_robot_that_the_watchdog_stopped_stays_so_until_the_server_is_heard_again() -> None:
    robot = Watched(Going.contract)
    at_bark: list[int] = []

    class Silent(Going):
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            silent_s = 60.0 if at_bark and self.tick < at_bark[0] + 20 else 0.0
            if not at_bark and self.tick > 3:
                silent_s = 60.0
                set_limit(watchdog, "server", 0.1)
            return Act(act.action, info={"silent_s": silent_s})

    agent = Silent()

    def bark(_: str) -> None:
        robot.stop()
        at_bark.append(agent.tick)

    watchdog = Watchdog(bark, {"server": 60.0})
    report = run_loop(
        robot, agent, hz=HZ, until=lambda: bool(at_bark) and agent.tick > at_bark[0] + 30, watchdog=watchdog
    )
    ticks = [round(100 * value) for value in robot.commanded]
    applied = [tick for tick in ticks if at_bark[0] + 1 < tick < at_bark[0] + 19]
    assert applied == []
    assert ticks[-1] >= at_bark[0] + 25  # and goes on then
    assert report.safe["stopped"] >= 17
    assert "no signal from the server" in report.reasons["stopped"]


class Hardware(Watched):
    """As far as the loop knows."""

    simulated = False


class Silenced(Going):
    """A server that is silent from its sixth action on until the test ends that."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))
    silent = True
    interrupts = 0

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        return Act(act.action, info={"silent_s": 1e6 if self.silent and self.tick > 5 else 0.0})

    def interrupt(self) -> None:
        self.interrupts += 1


@pytest.mark.parametrize("restart", [None, "manual", "auto"])
def test_after_a_protective_stop_hardware_moves_only_when_it_is_told(restart: Any) -> None:
    robot, agent = Hardware(Going.contract), Silenced()
    told: list[tuple[bool, int]] = []  # whether a restart was granted, and at which tick
    barked_at: list[int] = []

    def bark(_: str) -> None:
        robot.stop()
        barked_at.append(agent.tick)
        watchdog._limits["server"] = 1e3  # on a busy machine it would bark again

    watchdog = Watchdog(bark, {"server": 60.0})

    def over() -> bool:
        if agent.tick == 5:  # what comes next is silence
            set_limit(watchdog, "server", 0.1)
        since = agent.tick - barked_at[0] if barked_at else 0
        if since == 10:
            told.append((watchdog.restart(), agent.tick))
        if since >= 20:
            agent.silent = False
        if since == 50:
            told.append((watchdog.restart(), agent.tick))
        return since > 80

    report = run_loop(robot, agent, hz=HZ, until=over, watchdog=watchdog, restart=restart)
    ticks = [round(100 * value) for value in robot.commanded]
    again = min(tick for tick in ticks if tick > barked_at[0] + 2)
    assert told[0][0] is False  # while it was silent
    assert told[1][0] is True
    assert ticks[-1] >= barked_at[0] + 75
    if restart == "auto":
        assert barked_at[0] + 18 <= again < barked_at[0] + 30
    else:
        assert again >= told[1][1] - 1
        assert report.safe["stopped"] >= 20
    assert agent.interrupts >= again - barked_at[0] - 3  # nothing of what it returned meanwhile was executed
    assert len(watchdog.barks) == 1


def test_a_simulated_robot_restarts_by_itself() -> None:
    robot, agent = Watched(Going.contract), Silenced()
    stopped_at: list[int] = []

    def bark(_: str) -> None:
        agent.silent = False
        watchdog._limits["server"] = 1e3

    watchdog = Watchdog(bark, {"server": 0.05})

    def over() -> bool:
        if watchdog.barks and not stopped_at:
            stopped_at.append(agent.tick)
        return bool(stopped_at) and agent.tick > stopped_at[0] + 30

    run_loop(robot, agent, hz=HZ, until=over, watchdog=watchdog)
    assert round(100 * robot.commanded[-1]) > stopped_at[0] + 20


@pytest.mark.parametrize("silent_s", [float("nan"), float("inf"), -5.0, "long", None, [1]])
def test_a_silence_that_is_no_time_counts_as_an_answer_of_now(silent_s: Any) -> None:
    class Strange(Going):
        def act(self, obs: Obs) -> Act:
            return Act(super().act(obs).action, info={"silent_s": silent_s})

    watchdog = Watchdog(lambda _: None, {"server": 60.0})
    report = run_loop(Watched(Going.contract), Strange(), hz=200, seconds=0.1, watchdog=watchdog)
    assert (report.barks, report.safe_ticks) == ([], 0)


@pytest.mark.parametrize(
    ("jumps", "limits", "cause"),
    [((0.3, 0.4, 0.5), {"max_step": 0.1}, "max_step"), ((2.0, 3.0, 4.0), {"high": 1.0}, "limits")],
)
def test_a_report_counts_refused_actions_by_cause_whatever_their_numbers(
    jumps: tuple[float, ...], limits: dict[str, float], cause: str
) -> None:
    class Jumping(Going):
        def act(self, obs: Obs) -> Act:
            self.tick += 1
            value = jumps[self.tick % len(jumps)] if self.tick > 1 else 0.0
            return Act(np.full(2, value, np.float32))

    agent = Jumping()
    with ChunkPlayer(agent, PlayerSettings(deadline_s=30.0), check=Guard(Going.contract, **limits)) as player:
        report = run_loop(Watched(Going.contract), player, hz=200, until=lambda: agent.tick > 12)
    assert set(report.safe) == {cause}
    assert report.safe[cause] == report.safe_ticks >= 10
    assert report.reasons[cause].startswith("action[0]: got")


def test_waiting_for_the_next_chunk_is_counted_apart_from_safe_actions() -> None:
    gate = threading.Event()

    class Late(Going):
        def act(self, obs: Obs) -> Act:
            if self.tick:
                gate.wait(30)
            return super().act(obs)

    robot = Watched(Going.contract)
    with ChunkPlayer(Late(), PlayerSettings(mode="async")) as player:
        report = run_loop(robot, player, hz=200, seconds=0.2)
        gate.set()
    assert (report.safe, report.waiting) == ({}, report.safe_ticks)
    assert report.waiting > 10
    assert "waiting for an answer" in str(report.mostly_safe)


def test_an_unknown_restart_is_refused() -> None:
    with pytest.raises(ConfigError, match="want one of"):
        run_loop(Watched(), Going(), hz=HZ, restart="later")  # type: ignore[arg-type]


def test_a_person_restarts_the_command_by_a_signal() -> None:
    said: list[str] = []
    stopped = threading.Event()
    with Watchdog(lambda _: stopped.set(), {"loop": 0.05}) as watchdog, restarting(watchdog, said.append):
        assert stopped.wait(30)
        os.kill(os.getpid(), signal.SIGUSR1)
        assert watchdog.control.stopped  # it hangs still
        watchdog._limits["loop"] = 60.0
        watchdog.heard("loop")
        assert watchdog.control.stopped
        watchdog.control.pause("paused from the live page")
        os.kill(os.getpid(), signal.SIGUSR1)
        assert not watchdog.control.stopped
        assert watchdog.control.reason is None
    assert signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL


def test_a_person_restarts_the_command_by_enter_at_its_terminal() -> None:
    code = """
import threading
from vlagents_ray.robot import Watchdog
from vlagents_ray.cli.robot import _restarting

stopped, restarted = threading.Event(), threading.Event()

def say(line):
    print(line, flush=True)
    if line == "restarted":
        restarted.set()

with Watchdog(lambda _: stopped.set(), {"loop": 0.05}) as watchdog, _restarting(watchdog, say):
    assert stopped.wait(30)
    watchdog._limits["loop"] = 60.0
    watchdog.heard("loop")
    print("stopped", flush=True)
    assert restarted.wait(30)
    assert not watchdog.control.stopped
"""
    with at_a_terminal(code) as (process, type_keys, lines):
        assert next(lines) == "stopped"
        type_keys("\n")
        assert next(lines) == "restarted"
        assert process.wait(30) == 0


def test_with_a_keyboard_as_leader_each_key_has_one_consumer_and_enter_restarts_nothing() -> None:
    """The command line of docs/interventions.md, whose server is a policy in its process."""
    code = """
import sys
import vlagents_ray.cli.robot as command
from vlagents_ray import Act, ActionSpec, Agent, Contract
from vlagents_ray.robot.teleoperation import Keyboard
import numpy as np

class Still(Agent):
    contract = Contract(action=ActionSpec(dim=6, delta=True))
    transport = "local"

    def __init__(self, *_, **__): ...

    def act(self, obs):
        return Act(np.zeros(6, np.float32))

class Seen(Keyboard):
    def _press(self, key):
        taken = super()._press(key)
        print("keyboard", repr(key), taken, flush=True)
        return taken

class Stopped(command.Watchdog):
    def start(self):
        super().start()
        self.trip("a person is in the way")

command.RemoteAgent, command.Watchdog, command._DEVICES["keyboard"] = Still, Stopped, Seen
sys.exit(command.main(sys.argv[1:]))
"""
    options = ["http://gpu-box:8000", "--leader", "keyboard", "--step", "0.01"]
    with at_a_terminal(code, *options) as (process, type_keys, lines):
        while "a person is in the way" not in next(lines):
            pass
        for _ in range(20):
            type_keys("w")
        type_keys("\n\nc")
        said = list(itertools.islice(lines, 24))
        assert said[:20] == ["keyboard 'w' True"] * 20
        assert said[20:22] == [r"keyboard '\n' True"] * 2, "Enter gives back and takes over"
        assert said[22:] == ["keyboard 'c' False", "restarted"]
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 128 + signal.SIGTERM


@contextlib.contextmanager
def at_a_terminal(code: str, *options: str) -> Iterator[tuple[Any, Callable[[str], object], Iterator[str]]]:
    """Run Python code at a terminal of its own: its process, what types keys there, and the lines that it prints."""
    ours, its = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", code, *options],
        stdin=its,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509 - nothing else is started meanwhile
    ) as process:
        assert process.stdout is not None
        too_long = threading.Timer(30, process.kill)  # then no further line comes
        too_long.start()
        try:
            yield process, lambda keys: os.write(ours, keys.encode()), map(str.strip, process.stdout)
        finally:
            too_long.cancel()
            process.kill()
    os.close(ours)
    os.close(its)


def test_before_the_first_action_and_after_a_stop_the_loops_guard_measures_where_the_robot_stands() -> None:
    guard = Guard(Going.contract, max_step=0.05, measure=lambda obs: obs.state["joints"])
    robot = Watched(Going.contract)
    run_loop(robot, Going(), hz=HZ, until=lambda: len(robot.commanded) >= 3, guard=guard)
    away = Watched(Going.contract)
    away._joints = away._target = np.full(2, 0.5, np.float32)
    with pytest.raises(InvalidAction, match=r"after 0\.5"):
        run_loop(away, Going(), hz=HZ, guard=guard)
    assert away.commanded == []

    class Still(Silenced):
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            return Act(act.action * 0, info=act.info)

    moved = Watched(Going.contract)
    agent = Still()

    def bark(_: str) -> None:
        moved._joints = moved._target = np.full(2, -0.9, np.float32)  # by hand
        watchdog._limits["server"] = 1e3
        agent.silent = False

    watchdog = Watchdog(bark, {"server": 0.1})
    with pytest.raises(InvalidAction, match=r"after -0\.9"):
        run_loop(moved, agent, hz=HZ, seconds=60.0, guard=guard, watchdog=watchdog)


def test_before_the_first_action_no_safe_one_is_commanded() -> None:
    class Waiting(Going):
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            return Act(act.action, info={"safe": "waiting"} if self.tick < 5 else {})

    robot = Watched(Going.contract)
    report = run_loop(robot, Waiting(), hz=HZ, until=lambda: len(robot.commanded) >= 3)
    assert robot.commanded[:2] == [0.04, 0.05]
    assert (report.safe, report.reasons) == ({"other": 4}, {"other": "waiting"})


def test_an_action_that_a_hanging_loop_was_late_with_is_not_applied() -> None:
    robot, agent = Watched(Going.contract), Hanging()
    run_loop(robot, agent, hz=HZ, watchdog=agent.watchdog)
    assert 0.03 not in robot.commanded
    assert robot.commanded[-1] == 0.05


def test_a_loop_that_runs_for_days_keeps_no_more_than_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlagents_ray.robot.pacing.KEPT_TICKS", 10)
    monkeypatch.setattr("vlagents_ray.robot.loop._COLLECT_S", 0.05)
    living: weakref.WeakSet[Failure] = weakref.WeakSet()
    most = 0

    class Failure(Exception):
        pass

    class Failing(Going):
        def act(self, obs: Obs) -> Act:
            nonlocal most
            try:
                raise Failure
            except Failure as error:
                kept = error  # a cycle: the error's traceback, this frame, the error
                living.add(kept)
            most = max(most, len(living))
            act = super().act(obs)
            return Act(act.action * 0, info={"safe": f"no answer within {self.tick} s"})

    report = run_loop(Watched(Going.contract), Failing(), hz=1000, seconds=1.0)
    ticks = report.jitter["ticks"]
    assert ticks + report.jitter["missed"] == 1000
    assert most <= 60  # 50 ticks, which are collected together, and those of a collection
    assert len(report.safe) == len(report.reasons) == 1
    assert report.safe_ticks == ticks
    pacer = Pacer(1000)
    for _ in range(30):
        pacer.wait()
    assert len(pacer.late_s) == 10
    assert jitter(pacer.late_s, pacer.missed, pacer.ticks)["ticks"] == 30


@pytest.mark.parametrize("wish", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_the_command_stops_the_robot_when_it_is_told_to_end(wish: signal.Signals) -> None:
    code = """
import sys, time
import vlagents_ray.cli.robot as command

def run(options):
    try:
        print("moving", flush=True)
        time.sleep(60)
    finally:
        print("stopped", flush=True)

command._run = run
command.main(["http://nowhere"])
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "moving\n"
        process.send_signal(wish)
        assert process.stdout.read() == "stopped\n"


@pytest.mark.parametrize("options", [{"hz": 0.0}, {"hz": float("nan")}, {"hz": 50.0, "seconds": 0.0}])
def test_a_rate_or_a_time_of_nothing_is_refused(options: dict) -> None:
    with pytest.raises(ConfigError, match="above 0"):
        run_loop(Watched(), Going(), **options)


def test_the_simulated_robot_gives_what_a_contract_asks_for() -> None:
    contract = Contract(
        cameras={"left": CameraSpec(48, 64)},
        state={"joints": StateSpec(3), "pose": StateSpec(6)},
        action=ActionSpec(dim=4, delta=True, gripper_open=1.0, gripper_closed=-1.0),
    )
    robot = SimulatedRobot(contract)
    first = robot.observe()
    assert first.cameras["left"].shape == (48, 64, 3)
    assert {name: part.shape for name, part in first.state.items()} == {"joints": (3,), "pose": (6,)}
    for _ in range(20):
        robot.apply(np.array([0.1, 0, 0, 0.05], np.float32))
        last = robot.observe()
    assert last.state["joints"][0] > 1
    assert (last.cameras["left"] != first.cameras["left"]).any()
    assert first.gripper is not None
    assert last.gripper is not None
    assert last.gripper > first.gripper


class Served(Going):
    """In place of the agent that the command would connect."""

    transport = "local"
    contract: Contract | None = Contract(action=ActionSpec(dim=2, delta=False), chunk=1)  # type: ignore[assignment]
    slow_s = 0.0

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def act(self, obs: Obs) -> Act:
        time.sleep(self.slow_s * (self.tick > 0))
        return super().act(obs)


SHORT = ["http://nowhere", "--seconds", "1"]
ATTEMPTS = 5  # what else the machine does in such a second may mislead


@pytest.mark.parametrize("mode", ["async", "open_loop", "ensemble"])
def test_the_command_drives_with_single_actions_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], mode: str
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    for _ in range(ATTEMPTS):
        status = main([*SHORT, "--hz", "10", "--mode", mode])
        said = re.search(r"ticks without an action of the policy: (\d+) of (\d+)", capsys.readouterr().out)
        assert said is not None
        safe, ticks = map(int, said.groups())
        if safe < 0.5 * ticks:  # none where the machine is not busy
            break
    assert safe < 0.5 * ticks
    assert status == (1 if safe else 0)


def test_the_simulated_robot_takes_actions_of_which_nothing_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    monkeypatch.setattr(Served, "contract", Contract(action=ActionSpec(dim=2)))
    assert main([*SHORT, "--hz", "10"]) in (0, 1, 3)  # a busy machine leaves ticks without an action


def test_a_run_of_safe_actions_does_not_look_like_success(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    monkeypatch.setattr(Served, "slow_s", 0.3)
    for _ in range(ATTEMPTS):  # on a busy machine there may be hardly a tick within the time
        status = main(SHORT)
        said = capsys.readouterr()
        if status == 3:
            break
        caplog.clear()
    assert status == 3
    assert "MOSTLY SAFE ACTIONS, exit status 3" in said.out
    assert (said.out + said.err + caplog.text).count("--deadline-ms") == 1


def test_the_command_lets_a_human_take_over_and_records_that(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    monkeypatch.setattr(Served, "contract", Contract(action=ActionSpec(dim=2, delta=False)))
    assert main([*SHORT, "--leader", "scripted_leader:HoldingLeader", "--record", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    ticks = int(re.search(r"an operator moved the robot: (\d+)", said)[1])  # type: ignore[index]
    rows = pq.read_table(tmp_path / "data/chunk-000/file-000.parquet").to_pydict()
    assert rows["intervention"] == [True] * ticks
    assert rows["action"] == [[0.25, 0.25]] * ticks


def test_a_setting_that_does_not_fit_is_refused_before_anything_is_timed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    monkeypatch.setattr(Served, "contract", None)
    assert main(["http://nowhere", "--robot", "vlagents_ray.robot.simulated:SimulatedRobot"]) == 2
    said = capsys.readouterr()
    assert "safe='hold'" in said.err
    assert "empty loop" not in said.out


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--hz", "0"], "argument --hz: got '0', want a number above 0"),
        (["--hz", "nan"], "argument --hz: got 'nan', want a number above 0"),
        (["--seconds", "-1"], "argument --seconds: got '-1', want a number above 0"),
        (["--execute", "0"], "argument --execute: got '0', want a whole number from 1"),
        (["--horizon", "1.5"], "argument --horizon: got '1.5', want a whole number from 1"),
        (["--max-age-s", "0"], "argument --max-age-s: got '0', want a number above 0"),
        (["--deadline-ms", "-1"], "argument --deadline-ms: got '-1', want a number from 0"),
        (["--silent-s", "soon"], "argument --silent-s: got 'soon', want a number above 0"),
        (["--mode", "open_loop", "--rtc"], "--merge and --rtc: got one of them with --mode open_loop"),
        (["--leader", "elsewhere:Pedal"], "--leader elsewhere:Pedal: No module named 'elsewhere'; go to the folder of"),
        (["--robot", "elsewhere:Arm"], "--robot elsewhere:Arm: No module named 'elsewhere'; go to the folder of"),
    ],
)
def test_options_are_checked_before_a_server_is_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: list[str], wanted: str
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", None)
    try:
        status: object = main([*SHORT, *options])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    assert wanted in capsys.readouterr().err


def test_errors_of_the_library_end_the_command_with_their_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
    monkeypatch.setattr(Served, "contract", Contract(action=ActionSpec(dim=2, delta=True)))
    assert main([*SHORT, "--safe", "hold"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("ConfigError: safe: got 'hold', which ")
    assert "give safe='zero', or 'auto'" in said
    assert main([*SHORT, "--measure", "joints"]) == 2
    assert capsys.readouterr().err.startswith("ConfigError: measure: got one for relative actions")


def test_the_command_says_what_it_cannot_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nonsense"]) == 2
    assert "want http(s)://" in capsys.readouterr().err


def test_a_class_that_is_no_robot_is_refused_with_what_it_lacks() -> None:
    with pytest.raises(ConfigError, match="--robot builtins:dict: lacks observe, apply, stop; want a class with"):
        import_class("--robot", "builtins:dict", ROBOT)
