"""Accepts clients at a listening socket, on the thread that polls for the batch queue."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

logger = logging.getLogger(__name__)


class Acceptor:
    """Accepts connections; errors (an aborted connection, EMFILE) never stop the listener."""

    def __init__(self, listener: socket.socket, on_connection: Callable[[socket.socket], None]) -> None:
        """Prepare to accept.

        Args:
            listener: The listening socket.
            on_connection: Called with each connection, which is non-blocking; it must close those that it refuses.
        """
        self._listener = listener
        self._on_connection = on_connection
        # Without a free descriptor a client could not even be refused, and the listener would stay readable.
        self._spare = _descriptor()

    def accept(self) -> None:
        """Accept one client; call it when the listener is readable."""
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            logger.warning("a client was not let in: %s", error)
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._refuse()
            return
        try:
            connection.setblocking(False)
            self._on_connection(connection)
        except Exception:
            logger.exception("a client was not let in")
            connection.close()

    def close(self) -> None:
        """Free the spare descriptor; the listener stays open."""
        self._spare.close()

    def _refuse(self) -> None:
        self._spare.close()
        with contextlib.suppress(OSError):
            self._listener.accept()[0].close()
        self._spare = _descriptor()


def _descriptor() -> BinaryIO:
    return Path(os.devnull).open("rb")
