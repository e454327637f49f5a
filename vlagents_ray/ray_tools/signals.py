"""Signal handlers: Ctrl-C and SIGTERM in a process that uses Ray, and an event that requests a
stop.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType

_interrupted = threading.Event()


@contextlib.contextmanager
def interrupts() -> Iterator[None]:
    """Raise `KeyboardInterrupt` on Ctrl-C and SIGTERM within the context, and record the signal.

    Python drops an exception that a handler raises while a destructor or a callback of Ray's C code
    runs; in that case `raise_dropped_interrupt` raises it later. Outside the main thread, where
    Python delivers no signals, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(number: int, frame: FrameType | None) -> None:
        _interrupted.set()
        signal.default_int_handler(number, frame)

    before = {
        number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _interrupted.clear()


def is_interrupted() -> bool:
    """Return whether Ctrl-C or SIGTERM has arrived within `interrupts`."""
    return _interrupted.is_set()


def raise_dropped_interrupt() -> None:
    """Raise `KeyboardInterrupt` if a signal arrived within `interrupts` and its exception was
    dropped.
    """
    if _interrupted.is_set():
        raise KeyboardInterrupt


@contextlib.contextmanager
def own_sigterm() -> Iterator[None]:
    """Preserve this process's SIGTERM handler during `ray.init`.

    Ray installs a handler whose alarm aborts the process three seconds later, during an orderly
    exit. If the process had no handler, Ray's remains.
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
def stop_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set; a second signal raises `KeyboardInterrupt`.

    A handler that only sets a flag cannot interrupt a transaction. Outside the main thread, where
    Python delivers no signals, the event is never set.
    """
    raise_dropped_interrupt()
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {
        number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def raised_at_once() -> Iterator[None]:
    """Raise `KeyboardInterrupt` in this thread on a signal within the context, after its handler
    has run.

    Code that looks at the event of `stop_signals` does so between two calls. A call that lasts
    needs this, unless it writes results. A signal without a handler keeps its default action.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}

    def on_signal(number: int, frame: FrameType | None) -> None:
        handlers[signal.Signals(number)](number, frame)
        raise KeyboardInterrupt

    for number in handlers:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
