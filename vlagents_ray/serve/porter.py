"""Lets clients in at a listening socket, where the batch queue hears."""

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


class Porter:
    """What goes wrong with one client keeps nobody else out: one that is gone already, one too many for the process."""

    def __init__(self, listener: socket.socket, welcome: Callable[[socket.socket], None]) -> None:
        """`welcome` gets each connection, which does not block, and closes it if it does not keep it."""
        self._listener = listener
        self._welcome = welcome
        # With no descriptor left, a client could not even be turned away, and would be heard of again and again.
        self._spare = _descriptor()

    def accept(self) -> None:
        """One client; whenever the listener can be read."""
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            logger.warning("a client was not let in: %s", error)
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._turn_away()
            return
        try:
            connection.setblocking(False)
            self._welcome(connection)
        except Exception:
            logger.exception("a client was not let in")
            connection.close()

    def close(self) -> None:
        """The listener stays open."""
        self._spare.close()

    def _turn_away(self) -> None:
        self._spare.close()
        with contextlib.suppress(OSError):
            self._listener.accept()[0].close()
        self._spare = _descriptor()


def _descriptor() -> BinaryIO:
    return Path(os.devnull).open("rb")
