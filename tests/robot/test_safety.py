"""What stands between a policy and the motors: bounds, and silence that is noticed."""

from __future__ import annotations

import queue
import threading
import time

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Contract, Obs
from vlagents_ray.errors import InvalidAction
from vlagents_ray.robot import Guard, Watchdog

BARK_S = 30.0  # generous: a watchdog that never barks is what fails


def row(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


GUARD = Guard(Contract(action=ActionSpec(dim=3, low=-1.0, high=1.0)))


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (row(0, 0), r"got \(2,\) float32, want \(3,\)"),
        (np.zeros((1, 3), np.float32), "single row"),
        (np.zeros(3, np.int64), "int64"),
        (row(0, np.nan, 0), "finite"),
        (row(0, np.inf, 0), "finite"),
        (row(0, 0, -1.01), r"action\[2\]: got -1.01, below the limit -1"),
        (row(0, 1.01, 0), r"action\[1\]: got 1.01, above the limit 1"),
    ],
)
def test_an_action_that_breaks_the_contract_is_refused_by_its_number(action: np.ndarray, said: str) -> None:
    with pytest.raises(InvalidAction, match=said):
        GUARD(action)


def test_an_action_within_the_contract_passes_as_it_is() -> None:
    action = row(-1, 0, 1)
    assert GUARD(action) is action


def test_the_stricter_of_the_contracts_and_ones_own_bounds_holds() -> None:
    guard = Guard(Contract(action=ActionSpec(low=-1.0, high=1.0)), high=np.array([2.0, 0.1]))
    guard(row(1, 0.1))
    for action in (row(1.5, 0), row(0, 0.2)):
        with pytest.raises(InvalidAction, match="above"):
            guard(action)


def test_a_jump_is_refused_and_a_first_action_is_none() -> None:
    guard = Guard(max_step=np.array([0.1, 5.0]))
    guard(row(9, 9))
    guard(row(0.05, 4), row(0, 0))
    with pytest.raises(InvalidAction, match=r"action\[0\]: got 0.2 after 0"):
        guard(row(0.2, 0), row(0, 0))


def test_while_the_robot_stands_the_measured_pose_counts_if_it_is_known() -> None:
    obs = Obs(state={"joints": row(1, 2)})
    last = row(0, 0)
    assert Guard().reference(obs, last) is last
    guard = Guard(measure=lambda obs: obs.state["joints"])
    for before in (last, None):
        pose = guard.reference(obs, before)
        assert pose is not None
        assert pose.tolist() == [1, 2]


def test_a_measured_pose_that_is_none_is_refused() -> None:
    obs = Obs(state={"joints": row(1, np.nan), "tick": row(1)})
    with pytest.raises(InvalidAction, match="finite"):
        Guard(measure=lambda obs: obs.state["joints"]).reference(obs, None)
    with pytest.raises(ConfigError, match=r"measure: got \(1,\), want \(2,\)"):
        Guard(measure=lambda obs: obs.state["tick"]).reference(obs, row(0, 0))
    with pytest.raises(ConfigError, match="measure: got one for relative actions"):
        Guard(Contract(action=ActionSpec(delta=True)), measure=lambda obs: obs.state["joints"])


@pytest.mark.parametrize("max_step", [float("nan"), -0.1, np.array([0.1, np.nan])])
def test_a_largest_step_that_would_bound_nothing_is_refused(max_step: float | np.ndarray) -> None:
    with pytest.raises(ConfigError, match="max_step"):
        Guard(max_step=max_step)


class Barks:
    def __init__(self) -> None:
        self.heard: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()

    def __call__(self, reason: str) -> None:
        self.heard.put((reason.partition(":")[0], threading.current_thread().name))

    def next(self) -> str:
        name, thread = self.heard.get(timeout=BARK_S)
        assert thread == "vlagents-ray-watchdog"
        return name


def test_what_was_stopped_stays_so_until_a_restart_after_the_silence() -> None:
    barks = Barks()
    watchdog = Watchdog(barks, {"server": 0.05})
    assert not watchdog.control.stopped
    with watchdog:
        barks.next()
        assert watchdog.control.stopped
        assert not watchdog.restart()  # while it is silent
        watchdog._limits["server"] = 60.0
        watchdog.heard("server")
        assert watchdog.control.stopped
        assert watchdog.restart()
        assert not watchdog.control.stopped


def test_what_is_heard_often_enough_is_left_alone() -> None:
    barks = Barks()
    with Watchdog(barks, {"server": 60.0, "loop": 0.05}) as watchdog:
        for _ in range(10):
            watchdog.heard("server")
            time.sleep(0.01)
        assert barks.next() == "loop"  # a hanging control loop
    assert [bark.partition(":")[0] for bark in watchdog.barks] == ["loop"]


def test_a_silence_calls_the_stop_hook_once_on_its_own_thread_until_there_is_news_of_now() -> None:
    barks = Barks()
    with Watchdog(barks, {"server": 0.1}) as watchdog:
        for _ in range(2):
            assert barks.next() == "server"
            time.sleep(0.3)  # several times the limit
            watchdog.heard("server", ago_s=0.2)
            assert watchdog.control.silent
            assert barks.heard.empty()
            watchdog.heard("server")
        assert barks.next() == "server"
    assert len(watchdog.barks) == 3


@pytest.mark.parametrize("ago_s", [float("nan"), float("inf"), -0.1])
def test_a_time_that_is_none_is_refused(ago_s: float) -> None:
    watchdog = Watchdog(print, {"server": 1.0})
    with pytest.raises(ConfigError, match="want a finite number from 0"):
        watchdog.heard("server", ago_s)
    with pytest.raises(ConfigError, match="above 0"):
        Watchdog(print, {"server": 0.0})


def test_a_stop_hook_that_fails_does_not_end_the_watch() -> None:
    calls: queue.SimpleQueue[str] = queue.SimpleQueue()

    def broken(reason: str) -> None:
        calls.put(reason)
        raise OSError("no bus")

    with Watchdog(broken, {"server": 0.05}) as watchdog:
        calls.get(timeout=BARK_S)
        watchdog.heard("server")
        calls.get(timeout=BARK_S)
    assert isinstance(watchdog.error, OSError)
