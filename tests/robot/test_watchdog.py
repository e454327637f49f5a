"""The watchdog: which silence stops a robot, and when it may move again."""

from __future__ import annotations

import queue
import threading
import time

import pytest

from vlagents_ray import ConfigError
from vlagents_ray.robot import Watchdog

BARK_S = 30.0  # a generous limit, since a watchdog that never triggers is the failure


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
        assert not watchdog.restart()  # during the silence
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
        assert barks.next() == "loop"  # the control loop hangs
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


@pytest.mark.parametrize("is_watched_again", [False, True])
def test_a_silence_of_an_earlier_run_lasts_only_if_its_source_is_still_watched(
    is_watched_again: bool,
) -> None:
    barks = Barks()
    with Watchdog(barks, {"camera": 0.05}) as earlier:
        barks.next()
    assert earlier.control.silent == ["camera"]

    later = Watchdog(barks, {"camera": 60.0} if is_watched_again else {"server": 60.0})
    later.share(earlier.control)
    with later:
        assert later.control.stopped
        assert later.restart() is not is_watched_again
        later.heard("camera")
        assert later.restart()
        assert not later.control.stopped


@pytest.mark.parametrize("ago_s", [float("nan"), float("inf"), -0.1])
def test_a_time_that_is_none_is_refused(ago_s: float) -> None:
    watchdog = Watchdog(print, {"server": 1.0})
    with pytest.raises(ConfigError, match="expected a finite number of seconds of 0 or more"):
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


def test_the_end_of_a_silence_is_reported_once_and_only_after_a_stop() -> None:
    barks, ended = Barks(), Barks()
    with Watchdog(barks, {"server": 0.1}, ended) as watchdog:
        for _ in range(2):
            watchdog.heard("server")
            assert ended.heard.empty()
            assert barks.next() == "server"
            for _ in range(3):
                watchdog.heard("server")
            assert ended.next() == "server"
        assert not watchdog.error


def test_an_error_of_what_is_called_after_a_silence_does_not_end_the_watchdog() -> None:
    def broken(source: str) -> None:
        raise OSError(source)

    barks = Barks()
    with Watchdog(barks, {"server": 0.05}, broken) as watchdog:
        for _ in range(2):
            assert barks.next() == "server"
            watchdog.heard("server")
        barks.next()
        assert isinstance(watchdog.error, OSError)
