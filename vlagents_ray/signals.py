"""Signal handlers: signals that end a command or a program that drives a robot, and a flag that
requests a stop.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType
from typing import NoReturn

_FIRST_WAKE_S = 0.05  # time for the main thread to run a handler by itself
_LONGEST_WAKE_S = 5.0  # native code may return early from a system call at each of these signals
_RAISE_AGAIN_S = 5.0  # time for a call to end after an interrupt, with its own clean-up
_POLL_S = 0.02  # period of `StopRequest.wait`
# The signals whose handlers end a command or restart a robot.
_DELIVERED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
_WAKE = signal.SIGURG  # a signal that processes ignore by default
# The signals that end a program: Ctrl-C, and the signals of systemd and of a closed terminal.
END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequest:
    """Whether a signal has requested a stop.

    A signal handler may set it at any time. It must not set a `threading.Event`: the main thread,
    which it interrupts, may hold the event's lock, and would wait for itself for ever.
    """

    def __init__(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        """Return whether a stop has been requested."""
        return self._is_set

    def set(self) -> None:
        """Request the stop."""
        self._is_set = True

    def clear(self) -> None:
        """Withdraw the request."""
        self._is_set = False

    def wait(self, timeout_s: float) -> bool:
        """Wait for the request, but at most `timeout_s`; return whether there is one."""
        end = time.monotonic() + timeout_s
        while not self._is_set:
            left_s = end - time.monotonic()
            if left_s <= 0:
                return False
            time.sleep(min(_POLL_S, left_s))
        return True


class _RaisingCall:
    """A call of the main thread that a signal ends; see `raised_at_once`."""

    def __init__(self) -> None:
        self.raise_at: float | None = None  # on the clock `time.monotonic`

    def raise_if_due(self) -> None:
        """Raise `KeyboardInterrupt` if the call continues after the interrupt for too long."""
        now = time.monotonic()
        if self.raise_at is not None and now >= self.raise_at:
            self.raise_at = now + _RAISE_AGAIN_S
            raise KeyboardInterrupt


class _Waker:
    """Interrupts blocking calls of the main thread until it has run the handlers of a signal.

    Python only runs a handler between two instructions of the main thread. A signal that arrives
    after the last instruction before a system call, or that the kernel delivers to another thread,
    does not interrupt the system call: a thread that waits for a lock would wait for ever. This
    thread sends another signal, whose handler does nothing, until the main thread runs handlers.
    """

    def __init__(self) -> None:
        self._main = threading.get_ident()
        self._woken = 0  # number of times that the main thread has run `_on_wake`
        self._ended = threading.Event()
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._thread = threading.Thread(target=self._watch, name="signals", daemon=True)

    @classmethod
    @contextlib.contextmanager
    def running(cls) -> Iterator[None]:
        """Run the thread within the context, unless it runs already, or this program uses the
        wakeup file descriptor or the signal for something else.
        """
        if _process.waker is not None or signal.getsignal(_WAKE) is not signal.SIG_DFL:
            yield
            return

        waker = cls()
        before = signal.set_wakeup_fd(waker._writer, warn_on_full_buffer=False)
        if before != -1:  # an event loop handles the signals
            signal.set_wakeup_fd(before)
            waker._close_pipe()
            yield
            return

        _process.waker = waker
        signal.signal(_WAKE, waker._on_wake)
        waker._thread.start()
        try:
            yield
        finally:
            _process.waker = None
            replaced = signal.set_wakeup_fd(-1)
            if replaced not in (-1, waker._writer):
                signal.set_wakeup_fd(replaced)
            signal.signal(_WAKE, signal.SIG_DFL)
            waker._ended.set()
            waker.look()
            waker._thread.join()
            waker._close_pipe()

    def look(self) -> None:
        """Make the thread check the running call."""
        with contextlib.suppress(BlockingIOError):  # the thread will check in any case
            os.write(self._writer, bytes([signal.SIGINT]))

    def _close_pipe(self) -> None:
        os.close(self._writer)
        os.close(self._reader)

    def _on_wake(self, _number: int, _frame: FrameType | None) -> None:
        self._woken += 1
        if _process.call is not None:
            _process.call.raise_if_due()

    def _watch(self) -> None:
        """Wake the main thread after each signal, and when an interrupt is to be raised again."""
        poll = select.poll()
        poll.register(self._reader, select.POLLIN)
        while not self._ended.is_set():
            call = _process.call
            raise_at = None if call is None else call.raise_at
            wait_ms = None
            if raise_at is not None:
                wait_ms = max(0.0, raise_at - time.monotonic()) * 1000
            if poll.poll(wait_ms):
                numbers = os.read(self._reader, 4096)
                if not any(number in _DELIVERED for number in numbers):
                    continue
            self._wake()

    def _wake(self) -> None:
        """Interrupt the main thread until it has run its handlers."""
        woken = self._woken
        delay_s = _FIRST_WAKE_S
        while not self._ended.wait(delay_s) and self._woken == woken:
            signal.pthread_kill(self._main, _WAKE)
            delay_s = min(2 * delay_s, _LONGEST_WAKE_S)


@dataclass(frozen=True, slots=True)
class _Ending:
    """A signal that ends the program.

    It does not keep the exception of the handler, whose traceback would keep the objects of all
    interrupted functions.
    """

    number: int
    status: int | None  # exit status of the program; None raises `KeyboardInterrupt`

    def raise_error(self) -> NoReturn:
        """Raise the exception that ends the program."""
        if self.status is None:
            raise KeyboardInterrupt
        raise SystemExit(self.status)


class _Process:
    """The contexts that the main thread has entered."""

    def __init__(self) -> None:
        self.ending: _Ending | None = None  # within `interrupts` and `ended_by_signals`
        self.stop: StopRequest | None = None  # flag of the innermost `stop_signals`
        self.call: _RaisingCall | None = None
        self.waker: _Waker | None = None


_process = _Process()


def _forget_waker() -> None:
    """In a child process: its signals must not wake the main thread of its parent."""
    if _process.waker is not None:
        _process.waker = None
        signal.set_wakeup_fd(-1)


os.register_at_fork(after_in_child=_forget_waker)


@contextlib.contextmanager
def delivered() -> Iterator[None]:
    """Run the handlers of SIGINT, SIGTERM, SIGHUP and SIGUSR1 soon after these signals within the
    context, whatever the main thread waits for.

    Native code that does not return to Python still delays them. Outside the main thread, where
    Python runs no handlers, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with _Waker.running():
        yield


@contextlib.contextmanager
def interrupts() -> Iterator[None]:
    """Raise `KeyboardInterrupt` on Ctrl-C and SIGTERM within the context, and record the signal.

    Python drops an exception that a handler raises while a destructor or a callback of Ray's C code
    runs. In that case, `raise_dropped` raises it later. Outside of the main thread, where Python
    delivers no signals, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, _: object) -> None:
        _process.ending = _Ending(number, None)
        _process.ending.raise_error()

    numbers = (signal.SIGINT, signal.SIGTERM)
    with delivered():
        before = {number: signal.signal(number, on_signal) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            _forget_ending(*numbers)


@contextlib.contextmanager
def ended_by_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Raise an exception at these signals within the context: `KeyboardInterrupt` at SIGINT,
    otherwise `SystemExit` with the status 128 + the number of the signal.

    A program that drives a robot uses this, so that the robot is stopped before the program ends.
    Further signals with the same number are ignored, since they would interrupt the stop. If Python
    drops the exception, `raise_dropped` raises it later. Ignored signals (such as SIGHUP under
    nohup) and the caller's own handlers are unchanged. Outside the main thread, where Python cannot
    set handlers, no handler is changed.
    """
    replaced: list[int] = []
    if threading.current_thread() is threading.main_thread():
        replaced = [number for number in numbers if _is_default(signal.getsignal(number))]

    def on_signal(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        status = None if number == signal.SIGINT else 128 + number
        _process.ending = _Ending(number, status)
        _process.ending.raise_error()

    with contextlib.ExitStack() as undo:
        if replaced:
            undo.enter_context(delivered())
            undo.callback(_forget_ending, *replaced)
        for number in replaced:
            undo.callback(signal.signal, number, signal.getsignal(number))
            signal.signal(number, on_signal)
        yield


def _is_default(handler: object) -> bool:
    """Return whether a program has not set this handler itself.

    `ray.init` sets a handler of SIGTERM. After `ray.shutdown`, Python still reports that handler,
    but the signal ends the process at once (Ray 2.60).
    """
    if handler in (signal.SIG_DFL, signal.default_int_handler):
        return True
    module: str = getattr(handler, "__module__", None) or ""
    return module.partition(".")[0] == "ray"


def _forget_ending(*numbers: int) -> None:
    """Forget the signal that ends the program if it is one of these."""
    if _process.ending is not None and _process.ending.number in numbers:
        _process.ending = None


def is_interrupted() -> bool:
    """Return whether a signal that ends the program has arrived within `interrupts` or
    `ended_by_signals`.
    """
    return _process.ending is not None


def raise_dropped() -> None:
    """Raise the exception of a signal that ends the program again, if Python may have dropped it:
    if the signal has arrived within `interrupts` or `ended_by_signals`, and the context continues.
    """
    if _process.ending is not None:
        _process.ending.raise_error()


@contextlib.contextmanager
def own_sigterm() -> Iterator[None]:
    """Preserve this process's SIGTERM handler during `ray.init`.

    Ray installs a handler that sets an alarm, which aborts the process three seconds later, during
    an orderly exit. If the process had no handler, Ray's handler remains.
    """
    before = signal.getsignal(signal.SIGTERM)
    if not callable(before) or threading.current_thread() is not threading.main_thread():
        yield
        return
    try:
        yield
    except SystemExit as ended:  # raised by Ray's handler
        raise KeyboardInterrupt from ended
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def stop_signals() -> Iterator[StopRequest]:
    """Yield a flag that Ctrl-C and SIGTERM set; a second signal raises `KeyboardInterrupt`.

    A handler that only sets a flag cannot interrupt a transaction. Outside the main thread, where
    Python delivers no signals, the flag is never set.
    """
    raise_dropped()
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    with delivered():
        outer, _process.stop = _process.stop, stop
        before = {
            number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            yield stop
        finally:
            _process.stop = outer
            for number, handler in before.items():
                signal.signal(number, handler)


def is_stopping() -> bool:
    """Return whether a signal has requested a stop within the running `stop_signals`."""
    return _process.stop is not None and _process.stop.is_set()


@contextlib.contextmanager
def raised_at_once(stopping_s: float = 0.0) -> Iterator[None]:
    """Raise `KeyboardInterrupt` in this thread on a signal within the context, after its handler
    has run.

    Code that uses `stop_signals` checks its flag between two calls. A long call must be wrapped in
    this context, unless it writes results. A signal without a handler keeps its default action. If
    the call catches the exception and continues, the exception is raised again.

    Args:
        stopping_s: The time that the call may take if `stop_signals` has received a signal before
            it, s. By default, `KeyboardInterrupt` is raised instead of the call.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}
    call = _RaisingCall()

    def on_signal(number: int, frame: FrameType | None) -> None:
        handlers[signal.Signals(number)](number, frame)
        call.raise_at = time.monotonic() + _RAISE_AGAIN_S
        raise KeyboardInterrupt

    outer, _process.call = _process.call, call
    try:
        for number in handlers:
            signal.signal(number, on_signal)
        # A signal that arrived before these handlers were installed has only set the flag.
        if is_stopping():
            if not stopping_s:
                raise KeyboardInterrupt
            call.raise_at = time.monotonic() + stopping_s
            if _process.waker is not None:
                _process.waker.look()
        yield
    finally:
        _process.call = outer
        for number, handler in handlers.items():
            signal.signal(number, handler)
