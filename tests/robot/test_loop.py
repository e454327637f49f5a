"""The control loop: its schedule, its behaviour after faults, and its reports."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from typing import Any

import numpy as np
import pytest
from process_resources import count_frozen

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    CameraSpec,
    ConfigError,
    Contract,
    Obs,
    PolicyFailed,
    StateSpec,
)
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.errors import InvalidAction
from vlagents_ray.robot import Guard, LoopOptions, Watchdog, run_loop
from vlagents_ray.robot.pacing import Pacer, jitter, undisturbed
from vlagents_ray.robot.simulated import SimulatedRobot

HZ = 200.0


class Going(Agent):
    """A policy with absolute targets that grow by 0.01 per tick."""

    contract = Contract(action=ActionSpec(dim=2, delta=False, low=-1.0, high=1.0))

    def __init__(
        self, *, wrong_at: int | None = None, done_at: int | None = None, slow_at: int | None = None
    ) -> None:
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
    """Change a limit of a running watchdog. With a short limit from the start, a busy machine could
    delay the loop's sign of life.
    """
    with watchdog._changed:
        watchdog._limits[name] = silent_s
        watchdog._changed.notify_all()


class Hanging(Going):
    """A policy whose fourth action returns only after the watchdog has stopped the robot."""

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
    """A robot that stores its commands."""

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

    def until() -> bool:  # called before each tick
        ticks.append(len(ticks))
        robot.holds = "the camera hangs" if 5 <= len(ticks) < 15 else None
        return len(ticks) > 20

    ticks: list[int] = []
    report = run_loop(robot, ChunkPlayer(Asked()), hz=HZ, until=until)
    assert (report.safe, report.reasons) == ({"robot": 10}, {"robot": "the camera hangs"})
    assert robot.stops == 2  # when it began to hold, and at the end
    assert len(robot.commanded) == 10
    assert asked[0] == 0
    assert len(asked) >= 2, "the earlier plan was dropped"


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
    told = jitter([0.0001, 0.0001, 0.003], missed=1)
    assert told["on_time"] == 0.5, "a missed tick counts as late"
    assert told["p50_ms"] == pytest.approx(0.1)
    assert told["max_ms"] == pytest.approx(3.0)


@pytest.mark.slow
@pytest.mark.parametrize("frozen", [False, True])
def test_the_process_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch, *, frozen: bool) -> None:
    monkeypatch.setattr(gc, "get_freeze_count", count_frozen)

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
            assert len(gc.get_objects()) < len(heap), (
                "a collection within the loop would scan all of them"
            )
        after = settings()
        assert (after[0], *after[2:]) == (before[0], *before[2:])
        assert (gc.get_freeze_count() >= before[1]) if frozen else (gc.get_freeze_count() == 0)
    finally:
        gc.freeze()  # as in conftest.py


@pytest.mark.parametrize("real_time", [False, True])
def test_where_threads_have_no_priorities_the_loop_does_without(
    monkeypatch: pytest.MonkeyPatch, *, real_time: bool
) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.delattr(os, "sched_getscheduler")
    # There is no such process.
    monkeypatch.setattr(os, "getpriority", lambda *_: os.kill(2**22 + 1, 0))
    with undisturbed(real_time=real_time) as done:
        assert "no priority (only on Linux)" in done


def test_a_robot_is_driven_for_as_long_as_was_said_and_then_stopped() -> None:
    robot, agent = Watched(Going.contract), Going()
    report = run_loop(robot, agent, hz=HZ, seconds=0.2, instruction="go")
    assert report.jitter["ticks"] + report.jitter["missed"] == 40
    assert robot.commanded == [round(0.01 * i, 4) for i in range(int(report.jitter["ticks"]))]
    assert (robot.stops, agent.instruction, report.safe_ticks) == (1, "go", 0)


@pytest.mark.parametrize(("slow_at", "ticks", "missed"), [(5, 60, 4), (9, 10, 0)])
def test_a_slow_tick_costs_the_ticks_until_the_end_that_it_covers(
    slow_at: int, ticks: int, missed: int
) -> None:
    report = run_loop(Watched(Going.contract), Going(slow_at=slow_at), hz=HZ, seconds=ticks / HZ)
    assert report.jitter["missed"] >= missed  # the next tick begins late, but within its period
    assert report.jitter["ticks"] + report.jitter["missed"] == ticks


def test_the_loop_ends_when_the_policy_is_done_or_the_caller_says_so() -> None:
    robot = Watched(Going.contract)
    report = run_loop(robot, Going(done_at=7), hz=HZ)
    assert report.done
    assert len(robot.commanded) == 8
    report = run_loop(robot, Going(), hz=HZ, until=lambda: len(robot.commanded) >= 12)
    assert not report.done
    assert len(robot.commanded) == 12


class Chunks(Agent):
    def act(self, obs: Obs) -> Act:
        return Act(np.zeros((5, 7), np.float32))


class Refusing(Agent):
    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        raise PolicyFailed("no weights")


@pytest.mark.parametrize(
    ("agent", "error", "said", "commanded"),
    [
        (Going(wrong_at=3), InvalidAction, "above the limit 1", [0, 0.01, 0.02]),
        (Chunks(), InvalidAction, "ChunkPlayer", []),
        (Refusing(), PolicyFailed, "no weights", []),
    ],
)
def test_an_error_stops_the_robot_before_an_action_of_it(
    agent: Agent, error: type[Exception], said: str, commanded: list[float]
) -> None:
    robot = Watched(Going.contract)
    with pytest.raises(error, match=said):
        run_loop(robot, agent, hz=HZ, seconds=1)
    assert (robot.commanded, robot.stops) == (commanded, 1)


def test_with_a_player_the_loop_goes_on_with_a_safe_action() -> None:
    robot = Watched(Going.contract)
    player = ChunkPlayer(
        Going(wrong_at=3), PlayerSettings(deadline_s=30.0), check=Guard(Going.contract)
    )
    report = run_loop(robot, player, hz=HZ, until=lambda: len(robot.commanded) >= 6)
    player.close()
    assert robot.commanded == [0, 0.01, 0.02, 0.02, 0.04, 0.05]
    assert report.safe_ticks == 1


def test_the_loop_has_no_other_guard_than_its_player() -> None:
    class Bounded(Going):
        contract = Contract(action=ActionSpec(dim=2, delta=False))

    robot, guard = Watched(Bounded.contract), Guard(high=0.025)
    player = ChunkPlayer(
        Bounded(), PlayerSettings(deadline_s=30.0, safe=np.full(2, 9.0)), check=guard
    )
    report = run_loop(robot, player, hz=HZ, until=lambda: len(robot.commanded) >= 6)
    # neither the rest of the plan nor the 9
    assert robot.commanded == [0, 0.01, 0.02, 0.02, 0.02, 0.02]
    assert report.safe_ticks == 3
    run_loop(robot, player, hz=HZ, seconds=0.05, options=LoopOptions(guard=guard))
    with pytest.raises(ConfigError, match="got both; leave out one of these"):
        run_loop(robot, player, hz=HZ, options=LoopOptions(guard=Guard(high=0.025)))
    player.close()


def test_a_safe_action_without_any_guard_passes_the_contracts_bounds() -> None:
    robot = Watched(Going.contract)
    player = ChunkPlayer(Going(wrong_at=3), PlayerSettings(deadline_s=30.0, safe=np.full(2, 9.0)))
    with pytest.raises(InvalidAction, match="above the limit 1"):
        run_loop(robot, player, hz=HZ, seconds=1)
    player.close()
    assert max(robot.commanded) < 0.03
    assert robot.stops == 1


def test_a_hanging_loop_is_noticed_by_the_watchdog_and_its_late_action_not_applied() -> None:
    robot, agent = Watched(Going.contract), Hanging()
    report = run_loop(robot, agent, hz=HZ, watchdog=agent.watchdog)
    assert [bark.partition(":")[0] for bark in report.barks] == ["loop"]
    assert 0.03 not in robot.commanded
    assert robot.commanded[-1] == 0.05


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
        robot,
        agent,
        hz=HZ,
        until=lambda: bool(at_bark) and agent.tick > at_bark[0] + 30,
        watchdog=watchdog,
    )
    ticks = [round(100 * value) for value in robot.commanded]
    applied = [tick for tick in ticks if at_bark[0] + 1 < tick < at_bark[0] + 19]
    assert applied == []
    assert ticks[-1] >= at_bark[0] + 25  # and the loop continues
    assert report.safe["stopped"] >= 17
    assert "no signal from the server" in report.reasons["stopped"]


class Hardware(Watched):
    """A robot that the loop treats as real hardware."""

    simulated = False


class Silenced(Going):
    """A policy whose server is silent from the sixth action until the test ends the silence."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))
    silent = True
    interrupts = 0

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        return Act(act.action, info={"silent_s": 1e6 if self.silent and self.tick > 5 else 0.0})

    def interrupt(self) -> None:
        self.interrupts += 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "restart"),
    [(Hardware, None), (Hardware, "manual"), (Hardware, "auto"), (Watched, None)],
)
def test_after_a_protective_stop_only_a_simulation_moves_by_itself_unless_it_is_told(
    kind: type[Watched], restart: Any
) -> None:
    robot, agent = kind(Going.contract), Silenced()
    told: list[tuple[bool, int]] = []  # whether a restart was accepted, and at which tick
    barked_at: list[int] = []

    def bark(_: str) -> None:
        robot.stop()
        barked_at.append(agent.tick)
        watchdog._limits["server"] = 1e3  # on a busy machine it would trigger again

    watchdog = Watchdog(bark, {"server": 60.0})

    def over() -> bool:
        if agent.tick == 5:  # the silence begins with the next tick
            set_limit(watchdog, "server", 0.1)
        since = agent.tick - barked_at[0] if barked_at else 0
        if since == 10:
            told.append((watchdog.restart(), agent.tick))
        if since >= 20:
            agent.silent = False
        if since == 50:
            told.append((watchdog.restart(), agent.tick))
        return since > 80

    report = run_loop(
        robot, agent, hz=HZ, until=over, watchdog=watchdog, options=LoopOptions(restart=restart)
    )
    ticks = [round(100 * value) for value in robot.commanded]
    again = min(tick for tick in ticks if tick > barked_at[0] + 2)
    assert told[0][0] is False  # during the silence
    assert told[1][0] is True
    assert ticks[-1] >= barked_at[0] + 75
    if restart == "auto" or kind is Watched:
        assert barked_at[0] + 18 <= again < barked_at[0] + 30
    else:
        assert again >= told[1][1] - 1
        assert report.safe["stopped"] >= 20
    # No action from the time of the stop was executed.
    assert agent.interrupts >= again - barked_at[0] - 3
    assert len(watchdog.barks) == 1


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
    with ChunkPlayer(
        agent, PlayerSettings(deadline_s=30.0), check=Guard(Going.contract, **limits)
    ) as player:
        report = run_loop(Watched(Going.contract), player, hz=200, until=lambda: agent.tick > 12)
    assert set(report.safe) == {cause}
    assert report.safe[cause] == report.safe_ticks >= 10
    assert report.reasons[cause].startswith("action[0]: expected")


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
    assert "use a lower rate (hz)" in str(report.mostly_safe)


def test_the_warning_of_a_robot_that_the_guard_holds_names_the_limit_and_not_the_rate() -> None:
    agent = Going()
    robot = Watched(Going.contract)
    settings = PlayerSettings(deadline_s=30.0, safe="hold")
    guard = Guard(Going.contract, max_step=0.05, measure=lambda _: np.full(2, 9.5, np.float32))
    with ChunkPlayer(agent, settings, check=guard) as player:
        report = run_loop(robot, player, hz=200, seconds=0.1)
    assert report.safe["max_step"] == report.safe_ticks > 1
    assert "expected a step of at most max_step, 0.05, got" in str(report.mostly_safe)
    assert "Compare the robot's pose" in str(report.mostly_safe)
    assert "use a lower rate" not in str(report.mostly_safe)


def test_before_the_first_action_and_after_a_stop_the_loops_guard_measures_where_the_robot_stands() -> (
    None
):
    guard = Guard(Going.contract, max_step=0.05, measure=lambda obs: obs.state["joints"])
    robot = Watched(Going.contract)
    run_loop(
        robot,
        Going(),
        hz=HZ,
        until=lambda: len(robot.commanded) >= 3,
        options=LoopOptions(guard=guard),
    )
    away = Watched(Going.contract)
    away._joints = away._target = np.full(2, 0.5, np.float32)
    with pytest.raises(InvalidAction, match=r"after 0\.5"):
        run_loop(away, Going(), hz=HZ, options=LoopOptions(guard=guard))
    assert away.commanded == []

    class Still(Silenced):
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            return Act(act.action * 0, info=act.info)

    moved = Watched(Going.contract)
    agent = Still()

    def bark(_: str) -> None:
        moved._joints = moved._target = np.full(2, -0.9, np.float32)  # moved by hand
        watchdog._limits["server"] = 1e3
        agent.silent = False

    watchdog = Watchdog(bark, {"server": 0.1})
    with pytest.raises(InvalidAction, match=r"after -0\.9"):
        run_loop(
            moved, agent, hz=HZ, seconds=60.0, watchdog=watchdog, options=LoopOptions(guard=guard)
        )


def test_before_the_first_action_no_safe_one_is_commanded() -> None:
    class Waiting(Going):
        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            return Act(act.action, info={"safe": "waiting"} if self.tick < 5 else {})

    robot = Watched(Going.contract)
    report = run_loop(robot, Waiting(), hz=HZ, until=lambda: len(robot.commanded) >= 3)
    assert robot.commanded[:2] == [0.04, 0.05]
    assert (report.safe, report.reasons) == ({"other": 4}, {"other": "waiting"})


def test_a_loop_that_runs_for_days_keeps_no_more_than_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
                kept = error  # a reference cycle of the error, its traceback and this frame
                living.add(kept)
            most = max(most, len(living))
            act = super().act(obs)
            return Act(act.action * 0, info={"safe": f"no answer within {self.tick} s"})

    report = run_loop(Watched(Going.contract), Failing(), hz=1000, seconds=1.0)
    ticks = report.jitter["ticks"]
    assert ticks + report.jitter["missed"] == 1000
    assert most <= 60  # 50 ticks, which are collected together, and the ticks during a collection
    assert len(report.safe) == len(report.reasons) == 1
    assert report.safe_ticks == ticks
    pacer = Pacer(1000)
    for _ in range(30):
        pacer.wait()
    assert len(pacer.late_s) == 10
    assert jitter(pacer.late_s, pacer.missed, pacer.ticks)["ticks"] == 30


@pytest.mark.parametrize(("hz", "seconds"), [(0.0, None), (float("nan"), None), (50.0, 0.0)])
def test_a_rate_and_a_length_are_above_zero(hz: float, seconds: float | None) -> None:
    with pytest.raises(ConfigError, match="above 0"):
        run_loop(Watched(), Going(), hz=hz, seconds=seconds)


def test_a_restart_is_manual_or_automatic() -> None:
    with pytest.raises(ConfigError, match="expected one of"):
        LoopOptions(restart="later")  # type: ignore[arg-type]


def test_the_simulated_robot_gives_what_a_contract_asks_for() -> None:
    contract = Contract(
        cameras={"left": CameraSpec(48, 64)},
        state={"joints": StateSpec(3), "pose": StateSpec(6)},
        action=ActionSpec(dim=4, delta=True, gripper_open=1.0, gripper_closed=-1.0),
    )
    robot = SimulatedRobot(contract)
    first = robot.observe()
    assert first.cameras["left"].shape == (48, 64, 3)
    assert {name: part.shape for name, part in first.state.items()} == {
        "joints": (3,),
        "pose": (6,),
    }
    for _ in range(20):
        robot.apply(np.array([0.1, 0, 0, 0.05], np.float32))
        last = robot.observe()
    assert last.state["joints"][0] > 1
    assert (last.cameras["left"] != first.cameras["left"]).any()
    assert first.gripper is not None
    assert last.gripper is not None
    assert last.gripper > first.gripper


ROBOT_OF_A_LIBRARY = """
import atexit
from vlagents_ray.robot.loop import opened

class Renderer:
    def __del__(self):
        print("the renderer is freed", flush=True)

class Arm:
    def __init__(self):
        self.cycle = [self, Renderer()]

    def observe(self):
        atexit.register(print, "the library ends", flush=True)

def run():
    with opened(Arm) as robot:
        robot.observe()

run()
"""


def test_a_robot_without_close_is_freed_before_its_libraries_end() -> None:
    """MuJoCo's renderers print a traceback if EGL has ended before they are freed."""
    done = subprocess.run(
        [sys.executable, "-c", ROBOT_OF_A_LIBRARY],
        capture_output=True, text=True, timeout=60, check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    assert done.stdout.splitlines() == ["the renderer is freed", "the library ends"]
    assert done.stderr == ""


class Chunking(Agent):
    """A policy that returns chunks, and must be open when it is used."""

    def __init__(self, delta: bool | None) -> None:
        self.is_open = False
        self._delta = delta

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2, delta=self._delta, low=-1.0), chunk=6)

    def initialize(self) -> None:
        self.is_open = True

    def act(self, obs: Obs) -> Act:
        assert self.is_open
        return Act(np.full((6, 2), 0.01, np.float32))

    def close(self) -> None:
        self.is_open = False


@pytest.mark.parametrize("delta", [True, False])
@pytest.mark.parametrize("guarded", [False, True])
def test_chunks_are_executed_in_the_mode_that_is_chosen_for_their_policy(
    delta: bool, guarded: bool, caplog: pytest.LogCaptureFixture
) -> None:
    agent = Chunking(delta)
    options = LoopOptions(guard=Guard(agent.contract) if guarded else None)
    caplog.set_level("INFO")
    for _ in range(2):  # the loop leaves the agent of its caller open
        robot = SimulatedRobot(agent.contract)
        report = run_loop(robot, agent, hz=50, seconds=0.2, options=options)
        assert report.timeliness.time_share.share > 0
        assert report.rows_per_tick is not None
        assert agent.is_open
    kind = "relative" if delta else "absolute"
    assert f"mode async: the contract declares {kind} actions; no measured" in caplog.text


def test_chunks_without_a_declared_meaning_need_a_safe_action_that_the_caller_knows() -> None:
    agent = Chunking(None)
    with pytest.raises(ConfigError, match="safe"):
        run_loop(SimulatedRobot(agent.contract), agent, hz=50, seconds=0.2)
