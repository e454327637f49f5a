"""Audit log of API keys, `vlagents_ray.serve.audit`: one line per key and kind of event, not one
per request.

    key arm-1: let in by websocket
    key arm-1: reset session 'robot-1'
    key arm-1: rejected: too_many_requests (57 more like this since the last line)
    key (none): rejected: an unknown key
    key lab: pressed 'pause' for session 'arm-1/7f3a'

A kind of event is logged immediately, and again after `_EVERY_S` at the earliest, with the number
of omitted events. Presses of the live page's buttons are always logged, even on a server without
keys. The log contains names of keys, never keys. Rejections have the level WARNING, all other
events INFO.
"""

from __future__ import annotations

import logging
import math
import sys
import threading
import time

LOG = "vlagents_ray.serve.audit"  # users' logging configurations refer to this name
logger = logging.getLogger(LOG)

_EVERY_S = 10.0


def write_audit() -> None:
    """Write this log to stderr, which Ray stores for each process, unless logging is already
    configured.
    """
    logger.setLevel(logging.INFO)
    if not logger.hasHandlers():
        handler = _StderrHandler()
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logger.addHandler(handler)


class _StderrHandler(logging.StreamHandler):  # type: ignore[type-arg]  # not generic in Python 3.10
    """Writes each line to the current `sys.stderr`, since a program may replace `sys.stderr` and
    close the old stream.
    """

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)


def log_pressed(name: str, command: str) -> None:
    """Log a command of the key `name` to a session; an empty name means a server without keys."""
    logger.info("key %s: pressed %s", name or "(none)", command)


class Audit:
    """Writes the audit log; thread-safe.

    Only names of known keys are passed, which bounds the number of kinds of events.
    """

    def __init__(self) -> None:
        # Time of the last line, s, monotonic, and the number of events since then, by name and
        # event.
        self._kinds: dict[tuple[str, str], tuple[float, int]] = {}
        self._lock = threading.Lock()

    def did(self, name: str, event: str, subject: str) -> None:
        """Log an action of the key `name`.

        Args:
            name: The name of the key.
            event: The kind of the action, such as "let in by" or "reset session".
            subject: The subject of the action, such as the name of the session.
        """
        suffix = self._count(name, event)
        if suffix is not None:
            logger.info("key %s: %s %s%s", name, event, subject, suffix)

    def refused(self, name: str, reason: str) -> None:
        """Log that the key `name` was rejected; an empty name means a missing or an unknown key."""
        suffix = self._count(name, reason)
        if suffix is not None:
            logger.warning("key %s: rejected: %s%s", name or "(none)", reason, suffix)

    def _count(self, name: str, event: str) -> str | None:
        """Count an event, and decide whether it is logged.

        Returns:
            The end of the event's line in the log, with the number of omitted events; None
            if such an event was logged within `_EVERY_S`.
        """
        now = time.monotonic()
        with self._lock:
            logged, omitted = self._kinds.get((name, event), (-math.inf, 0))
            is_due = now - logged >= _EVERY_S
            self._kinds[name, event] = (now, 0) if is_due else (logged, omitted + 1)

        if not is_due:
            return None
        return f" ({omitted} more like this since the last line)" if omitted else ""
