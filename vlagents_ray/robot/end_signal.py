"""The signals that end a program which drives a robot: they become exceptions, so that the robot is
stopped.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator

from vlagents_ray.signals import delivered

# The signals of systemd and of a closed terminal, which by default end the process at once.
END_SIGNALS = (signal.SIGTERM, signal.SIGHUP)


class EndSignal:
    """The signal that ends a program, once it has arrived."""

    def __init__(self) -> None:
        self._number: int | None = None

    def on_signal(self, number: int, _: object) -> None:
        """Record the signal, and raise the exception that ends the loop."""
        # Ignore further signals, which would interrupt the stop.
        signal.signal(number, signal.SIG_IGN)
        self._number = number
        self.raise_if_received()

    def raise_if_received(self) -> None:
        """Raise the exception again if there was a signal, since Python drops an exception that a
        handler raises in a destructor.
        """
        if self._number == signal.SIGINT:
            raise KeyboardInterrupt
        if self._number is not None:
            sys.exit(128 + self._number)


@contextlib.contextmanager
def ended_by_signals(*numbers: signal.Signals) -> Iterator[EndSignal]:
    """Raise an exception at these signals within the context: `KeyboardInterrupt` at SIGINT,
    otherwise `SystemExit` with the status 128 + the number of the signal.

    Ignored signals (such as SIGHUP under nohup) and the caller's own handlers are unchanged.
    Outside the main thread, where Python cannot set handlers, no handler is changed.
    """
    end_signal = EndSignal()
    with contextlib.ExitStack() as undo:
        if threading.current_thread() is threading.main_thread():
            by_default = (signal.SIG_DFL, signal.default_int_handler)
            replaced = [number for number in numbers if signal.getsignal(number) in by_default]
            if replaced:
                undo.enter_context(delivered())
            for number in replaced:
                undo.callback(signal.signal, number, signal.getsignal(number))
                signal.signal(number, end_signal.on_signal)
        yield end_signal
