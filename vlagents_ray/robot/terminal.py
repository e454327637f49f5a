"""Delivery of the keys typed at a terminal to consumers; each key goes to exactly one consumer."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable, Iterator

from vlagents_ray.errors import ConfigError

# A function that receives a key in lower case, and returns whether it handles the key.
Consumer = Callable[[str], bool]


class Terminal:
    """A terminal whose keys go to the newest consumer, such as a keyboard leader that moves the
    robot.

    A key that this consumer does not handle goes to the consumer before it, and so on; a consumer
    that reads in the background is the last. All objects for the same terminal share its consumers.

    Args:
        descriptor: The file descriptor of the terminal; default: standard input.

    Raises:
        ConfigError: The descriptor is not a terminal.
    """

    # The consumers of all terminals of this process, by the terminal's device and inode.
    _consumers: dict[tuple[int, int], list[Consumer]] = {}  # noqa: RUF012 - shared on purpose
    _lock = threading.RLock()

    def __init__(self, descriptor: int | None = None) -> None:
        if descriptor is None and sys.stdin is not None:
            # A replacement of `sys.stdin` need not be a file.
            with contextlib.suppress(OSError, ValueError):
                descriptor = sys.stdin.fileno()
        if descriptor is None or not os.isatty(descriptor):
            raise ConfigError(
                "terminal: expected a terminal to read keys from, got none; run this in one"
            )
        self.descriptor = descriptor
        status = os.fstat(descriptor)
        # The consumers of this terminal, oldest first; all objects for this terminal share the
        # list.
        self._own_consumers = self._consumers.setdefault((status.st_dev, status.st_ino), [])

    @contextlib.contextmanager
    def keys_at_once(self) -> Iterator[None]:
        """Deliver each key at once, without echo, within the context; Ctrl-C still works."""
        import termios
        import tty

        # In the background, changing the terminal would suspend the process.
        if not self._is_in_foreground():
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
        """Pass the keys to a consumer within the context, as the newest consumer or, with `last`,
        after all others.
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
            Whether the terminal is still open.

        Raises:
            ConfigError: The context of `consumed_by` has not begun for this consumer.
        """
        with self._lock:
            if consumer not in self._own_consumers:
                raise ConfigError(
                    "terminal: expected a consumer within its context, got one whose context has "
                    "not begun; use it in a `with` block"
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
        """Pass a key to the consumers, newest first, until one handles it."""
        for consumer in reversed(self._own_consumers):
            if consumer(key):
                return

    @contextlib.contextmanager
    def read_in_background(self, consumer: Consumer) -> Iterator[None]:
        """Pass keys that no other consumer handles to this consumer, from a thread, within the
        context.
        """
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
        # The terminal is not this process's controlling terminal, so reading does not suspend the
        # process.
        except OSError:
            return True


@contextlib.contextmanager
def typed_keys(consumer: Consumer) -> Iterator[bool]:
    """Pass the keys typed at the terminal to a consumer within the context, unless a newer consumer
    handles them.

    Args:
        consumer: The consumer, which may be called from a thread.

    Yields:
        Whether there is a terminal.
    """
    terminal = None
    with contextlib.suppress(ConfigError):  # standard input is not a terminal
        terminal = Terminal()
    if terminal is None:
        yield False
        return
    with terminal.keys_at_once(), terminal.read_in_background(consumer):
        yield True
