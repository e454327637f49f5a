"""The thread that accepts the clients of a dialect with its own port, at a bounded rate."""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable

from vlagents_ray.serve.endpoints.connection import BACKLOG, accept_open
from vlagents_ray.serve.token_bucket import TokenBucket
from vlagents_ray_dialects.client_reader import shut_down

logger = logging.getLogger(__name__)

TICK_S = 0.5  # the period at which a dialect checks its clients
# Maximum number of connections in a second; each takes a thread and about a millisecond.
_ACCEPTED_PER_S = 50.0
_END_S = 3.0  # the time limit for joining the thread, s


class Acceptor:
    """Accepts connections until it is closed; connections above the rate wait in the listener's
    backlog.

    Connections that their clients have ended are closed, and do not count.

    Args:
        name: The name of the dialect.
        listener: A bound socket, which the acceptor closes.
        add: Called with each connection; serves it on another thread, or closes it. It must not
            block.
        check_clients: Called on the acceptor's thread every `TICK_S`.
    """

    def __init__(
        self,
        name: str,
        listener: socket.socket,
        add: Callable[[socket.socket], None],
        check_clients: Callable[[], None] = lambda: None,
    ) -> None:
        self._name = name
        self._listener = listener
        self._add = add
        self._check_clients = check_clients
        self._closing = threading.Event()

        listener.listen(BACKLOG)
        listener.settimeout(TICK_S)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def alive(self) -> bool:
        """Return whether connections are accepted."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Accept no more connections, and close the listener."""
        self._closing.set()
        shut_down(self._listener)
        self._thread.join(_END_S)

    def _run(self) -> None:
        """Accept connections; runs on its own thread."""
        rate = TokenBucket(_ACCEPTED_PER_S, time.monotonic())
        checked_at = float("-inf")
        with self._listener:
            while not self._closing.is_set():
                now = time.monotonic()
                if now - checked_at >= TICK_S:
                    checked_at = now
                    self._check_clients()

                wait_s = rate.take(now)
                if wait_s > 0:
                    time.sleep(wait_s)
                    continue

                try:
                    connection = accept_open(self._listener)
                except TimeoutError:
                    rate.give_back()
                    continue
                except OSError as error:
                    rate.give_back()
                    if not self._closing.is_set():
                        logger.warning("%s: cannot accept a client: %s", self._name, error)
                        # If no descriptors are left, other connections must end before the next
                        # attempt.
                        time.sleep(0.1)
                    continue

                if connection is None:
                    rate.give_back()
                else:
                    self._add(connection)
