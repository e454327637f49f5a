"""What a signal does to a process in which Ray runs."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def own_sigterm() -> Iterator[None]:
    """Around `ray.init`: SIGTERM goes on doing what this process had asked for before.

    Ray puts a handler before Python's that lets an alarm abort the process three seconds later, in the middle of an
    orderly end. Where nothing had been asked for, Ray's stays.
    """
    before = signal.getsignal(signal.SIGTERM)
    yield
    if callable(before) and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)
