"""The keys typed at a terminal, each of which has exactly one consumer."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator

from vlagents_ray.errors import ConfigError

# A function that handles a key in lower case, and returns whether the key has a meaning for it.
Consumer = Callable[[str], bool]


class Terminal:
    """A terminal whose keys go to the newest consumer, such as a keyboard that moves the robot.

    A key that has no meaning for it goes to the consumer before, and last to one that reads in the
    background. Two objects of one terminal share its consumers.

    Args:
        descriptor: The file descriptor of the terminal; default: the one of standard input.

    Raises:
        ConfigError: The descriptor is not a terminal.
    """

    _consumers: dict[tuple[int, int], list[Consumer]] = {}  # noqa: RUF012 - of all terminals of this process
    _lock = threading.RLock()

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None and sys.stdin is not None:
            # A replacement of standard input need not be a file.
            with contextlib.suppress(OSError, ValueError):
                descriptor = sys.stdin.fileno()
        if descriptor is None or not os.isatty(descriptor):
            raise ConfigError(
                "terminal: expected a terminal to read keys from, got none; run this in one"
            )
        self.descriptor = descriptor
        status = os.fstat(descriptor)
        # The consumers of this terminal, oldest first, which all objects of it share.
        self._own_consumers = self._consumers.setdefault((status.st_dev, status.st_ino), [])

    @contextlib.contextmanager
    def keys_at_once(self) -> Iterator[None]:
        """Deliver each key at once, without echo, within the context; Ctrl-C still works."""
        import termios
        import tty

        if not self._is_in_foreground():  # else changing the terminal would suspend the process
            yield
            return
        before = termios.tcgetattr(self.descriptor)
        tty.setcbreak(self.descriptor)
        try:
            yield
        finally:
            termios.tcsetattr(self.descriptor, termios.TCSADRAIN, before)

    @contextlib.contextmanager
    def consumed_by(self, consumer: Consumer, *, last: bool = False) -> Iterator[None]:
        """Pass the keys to a consumer within the context, as the newest or, with `last`, after
        all others.
        """
        with self._lock:
            self._own_consumers.insert(0 if last else len(self._own_consumers), consumer)
        try:
            yield
        finally:
            with self._lock:
                self._own_consumers.remove(consumer)

    def read(self, consumer: Consumer) -> bool:
        """Pass typed keys to their consumers, if this consumer is the newest.

        Args:
            consumer: The consumer that reads.

        Returns:
            Whether the terminal is open.

        Raises:
            ConfigError: The context of `consumed_by` has not begun for this consumer.
        """
        with self._lock:
            if consumer not in self._own_consumers:
                raise ConfigError(
                    "terminal: expected a consumer in use, got one that has not begun; put "
                    "`with` around its use"
                )
            if self._own_consumers[-1] != consumer:
                return True

            while self._is_in_foreground() and select.select([self.descriptor], [], [], 0)[0]:
                typed = b""
                with contextlib.suppress(OSError):
                    typed = os.read(self.descriptor, 1024)
                if not typed:
                    return False
                for key in typed.decode(errors="replace").lower().replace("\r", "\n"):
                    self._pass_key(key)
            return True

    def _pass_key(self, key: str) -> None:
        """Pass a key to the consumers, the newest first, until one has a meaning for it."""
        for consumer in reversed(self._own_consumers):
            if consumer(key):
                return

    @contextlib.contextmanager
    def read_in_background(self, consumer: Consumer) -> Iterator[None]:
        """Pass keys without another consumer to this one, from a thread, within the context."""
        over = threading.Event()

        def read() -> None:
            """Read keys until the context ends."""
            while self.read(consumer) and not over.wait(0.1):
                pass

        thread = threading.Thread(target=read, name="vlagents-ray-terminal", daemon=True)
        with self.consumed_by(consumer, last=True):
            thread.start()
            try:
                yield
            finally:
                over.set()
                thread.join()

    def _is_in_foreground(self) -> bool:
        """Return whether this process may read: in the background, reading from the terminal
        would suspend it.
        """
        try:
            return os.tcgetpgrp(self.descriptor) == os.getpgrp()
        except OSError:  # not this process's controlling terminal, so reading suspends nothing
            return True


@contextlib.contextmanager
def typed_keys(consumer: Consumer) -> Iterator[bool]:
    """Pass the keys typed at the terminal to a consumer within the context, unless they have a
    meaning for a newer consumer.

    Args:
        consumer: The consumer, which may be called from a thread.

    Yields:
        Whether there is a terminal.
    """
    terminal = None
    with contextlib.suppress(ConfigError):  # standard input is no terminal
        terminal = Terminal()
    if terminal is None:
        yield False
        return
    with terminal.keys_at_once(), terminal.read_in_background(consumer):
        yield True
