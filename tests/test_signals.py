"""One signal ends what the main thread does, at whatever moment it arrives."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from vlagents_ray import signals
from vlagents_ray.signals import (
    StopRequest,
    delivered,
    interrupts,
    raised_at_once,
    stop_signals,
)

# A program in which each round must end by one signal. If it hangs, it prints the stacks of its
# threads, and ends with status 1.
PROGRAM = """
import faulthandler, os, random, signal, sys, threading, time
from vlagents_ray.signals import delivered, interrupts, raised_at_once, stop_signals

faulthandler.dump_traceback_later(30, exit=True)
NUMBERS = [signal.SIGINT, signal.SIGTERM]
moments = random.Random(1)


def hang():
    while True:
        try:
            threading.Event().wait()
        except Exception:
            pass


def on_another_thread(number):
    '''Deliver a signal to a thread that does not run handlers, as the kernel may.'''
    def taken():
        time.sleep(0.05)
        signal.pthread_kill(threading.get_ident(), number)
    threading.Thread(target=taken).start()


def after_a_moment(number, longest_s):
    '''Send a signal to this process, after a time up to `longest_s`.'''
    wait_s = moments.uniform(0, longest_s)
    def sent():
        end = time.perf_counter() + wait_s
        while time.perf_counter() < end:
            time.sleep(0)
        os.kill(os.getpid(), number)
        arrived.release()
    arrived = threading.Semaphore(0)
    threading.Thread(target=sent).start()
    return arrived

{body}
print("ended", flush=True)
"""


def run_program(body: str) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("{body}", body)],
        check=False,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (ended.returncode, ended.stdout) == (0, "ended\n"), ended.stderr
    assert not ended.stderr


@pytest.mark.parametrize(
    "contexts", ["interrupts()", "stop_signals(), raised_at_once()"], ids=["command", "evaluation"]
)
def test_a_signal_that_another_thread_gets_ends_a_wait(contexts: str) -> None:
    run_program(f"""
for number in NUMBERS:
    try:
        with {contexts}:
            on_another_thread(number)
            hang()
    except KeyboardInterrupt:
        pass
""")


@pytest.mark.slow
def test_a_signal_at_any_moment_ends_a_wait() -> None:
    """The moments sweep the instructions before a system call, after the last one at which Python
    runs handlers.
    """
    run_program("""
with delivered():
    for round in range(1000):
        try:
            with stop_signals(), raised_at_once():
                after_a_moment(NUMBERS[round % 2], 0.0002)
                hang()
        except KeyboardInterrupt:
            pass
""")


@pytest.mark.slow
def test_a_signal_at_any_moment_sets_the_flag_that_the_main_thread_waits_for() -> None:
    """The handler takes no lock that the main thread may hold."""
    run_program("""
for round in range(500):
    with stop_signals() as stop:
        arrived = after_a_moment(NUMBERS[round % 2], 0.0005)
        while not stop.wait(0.0):
            pass
        arrived.acquire()
""")


def test_a_signal_restarts_a_robot_while_its_loop_waits() -> None:
    run_program("""
lock = threading.Lock()
lock.acquire()
signal.signal(signal.SIGUSR1, lambda *_: lock.release())
with delivered():
    on_another_thread(signal.SIGUSR1)
    assert lock.acquire(timeout=20)
""")


def test_a_call_does_not_begin_after_a_stop_was_requested() -> None:
    with stop_signals() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt), raised_at_once():
            pytest.fail("it began")


def test_a_call_that_closes_may_take_its_time_after_a_stop_was_requested_but_not_longer() -> None:
    with stop_signals():
        signal.raise_signal(signal.SIGTERM)
        with raised_at_once(60.0):
            time.sleep(0.01)
        begun = time.monotonic()
        with pytest.raises(KeyboardInterrupt), raised_at_once(0.3):
            threading.Event().wait(60)
        assert 0.3 <= time.monotonic() - begun < 30


def test_an_interrupt_that_a_call_swallows_is_raised_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signals, "_RAISE_AGAIN_S", 0.2)
    swallowed = []

    def call() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            swallowed.append(error)
        threading.Event().wait(60)

    with stop_signals() as stop:
        with pytest.raises(KeyboardInterrupt), raised_at_once():
            call()
        assert stop.is_set()
    assert swallowed


def test_an_interrupt_is_not_raised_again_after_its_call(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "_RAISE_AGAIN_S", 0.1)
    with stop_signals():
        with pytest.raises(KeyboardInterrupt), raised_at_once():
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.5)  # results are written here


def test_handlers_and_thread_end_with_their_context() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    threads = threading.active_count()
    with interrupts(), delivered(), stop_signals():
        assert threading.active_count() == threads + 1
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.getsignal(signal.SIGURG) is signal.SIG_DFL
    assert signal.set_wakeup_fd(-1) == -1
    assert threading.active_count() == threads


def test_a_wakeup_descriptor_of_the_program_is_left_alone() -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    signal.set_wakeup_fd(writer)
    try:
        with delivered(), stop_signals() as stop:
            signal.raise_signal(signal.SIGTERM)
            assert stop.is_set()
        assert os.read(reader, 10) == bytes([signal.SIGTERM])
    finally:
        assert signal.set_wakeup_fd(-1) == writer
        os.close(reader)
        os.close(writer)


def test_signals_of_a_forked_child_do_not_wake_its_parent() -> None:
    run_program("""
from vlagents_ray import signals
with delivered():
    signal.signal(signal.SIGTERM, lambda *_: os._exit(7))
    child = os.fork()
    if child == 0:
        assert signals._process.waker is None
        signal.pause()
        os._exit(1)
    time.sleep(0.2)
    os.kill(child, signal.SIGTERM)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    time.sleep(0.3)
    assert signals._process.waker._woken == 0
""")


def test_a_wait_for_a_request_has_a_limit() -> None:
    stop = StopRequest()
    assert not stop.wait(0.05)
    stop.set()
    assert stop.wait(60)
