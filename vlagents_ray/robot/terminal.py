"""The only reader of a terminal at a robot, so that each key that is typed has exactly one consumer."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator

from vlagents_ray.errors import ConfigError

_POLL_S = 0.1
Consumer = Callable[[str], bool]  # gets a key in lower case; returns whether it has a meaning for that key


class Terminal:
    """A terminal whose keys go to the consumer that began last, such as a keyboard that moves the robot.

    A key that has no meaning for it goes to the one before, and last to one that reads in the background. Two objects
    of one terminal share its consumers.

    Args:
        descriptor: The file descriptor of the terminal; default: that of standard input.

    Raises:
        ConfigError: There is no terminal.
    """

    _consumers: dict[tuple[int, int], list[Consumer]] = {}  # noqa: RUF012 - of all terminals of this process
    _lock = threading.RLock()

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None and sys.stdin is not None:
            with contextlib.suppress(OSError, ValueError):  # what stands in for standard input need not be a file
                descriptor = sys.stdin.fileno()
        if descriptor is None or not os.isatty(descriptor):
            raise ConfigError("terminal: got no terminal, want one to read keys from; run this in one")
        self.descriptor = descriptor
        about = os.fstat(descriptor)
        self._own = self._consumers.setdefault((about.st_dev, about.st_ino), [])

    @contextlib.contextmanager
    def keys_at_once(self) -> Iterator[None]:
        """Deliver keys at once within the context, without echo, and not line by line; Ctrl-C stays."""
        import termios
        import tty

        before = termios.tcgetattr(self.descriptor)
        tty.setcbreak(self.descriptor)
        try:
            yield
        finally:
            termios.tcsetattr(self.descriptor, termios.TCSADRAIN, before)

    @contextlib.contextmanager
    def consumed_by(self, consumer: Consumer) -> Iterator[None]:
        """Let a consumer get the keys within the context, unless another one begins in it."""
        with self._lock:
            self._own.append(consumer)
        try:
            yield
        finally:
            with self._lock:
                self._own.remove(consumer)

    def read(self, consumer: Consumer) -> bool:
        """Give the keys that were typed to their consumers, if this one began last; returns at once.

        Returns:
            Whether the terminal is open.
        """
        with self._lock:
            if consumer not in self._own:
                raise ConfigError("terminal: this consumer has not begun; want `with` around its use")
            if self._own[-1] != consumer:
                return True
            while self._is_in_foreground() and select.select([self.descriptor], [], [], 0)[0]:
                try:
                    typed = os.read(self.descriptor, 1024)
                except OSError:
                    return False
                if not typed:
                    return False
                for key in typed.decode(errors="replace").lower().replace("\r", "\n"):
                    any(one(key) for one in reversed(self._own))
            return True

    @contextlib.contextmanager
    def read_in_background(self, consumer: Consumer) -> Iterator[None]:
        """Let a consumer get the keys that no other one takes; a thread reads them while there is no other one."""
        over = threading.Event()

        def read() -> None:
            while self.read(consumer) and not over.wait(_POLL_S):
                pass

        thread = threading.Thread(target=read, name="vlagents-ray-terminal", daemon=True)
        with self._lock:
            self._own.insert(0, consumer)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            with self._lock:
                self._own.remove(consumer)

    def _is_in_foreground(self) -> bool:
        """Whether this process may read: to read from the terminal in the background would suspend it."""
        try:
            return os.tcgetpgrp(self.descriptor) == os.getpgrp()
        except OSError:  # it is not this process's controlling terminal, which suspends none
            return True
