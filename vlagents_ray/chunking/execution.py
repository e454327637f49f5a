"""The record of what a chunk player executed, for the policy and, while the server is watched, for its viewers."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

from vlagents_ray.chunking.fallback import Held, unanswered
from vlagents_ray.errors import DeadlineExceeded, VLAgentsError
from vlagents_ray.interface import AGE_MS, EXECUTED, SAFE, Act, Agent

PLAYED = "played"  # the entry of `Obs.info`
WATCHED = "watched"  # the entry of `Act.info` with which a server says that somebody watches; it repeats that
_WATCHED_S = 10.0  # time after which that is over unless it is said again
_IN_PLACE = 256  # most actions between two requests that were executed in place of the policy's
_ROWS = 64  # most actions between two requests that are stated; older ones are left out


class Execution:
    """Collects what one episode executes, and states it once in the next request."""

    def __init__(self) -> None:
        """Begin an episode."""
        self._rows: deque[tuple[int, np.ndarray]] = deque(maxlen=_ROWS)
        self._age_ms: float | None = None
        self._safe = ""
        self._safe_ticks = self._spells = self._late = 0
        self._watched_until = float("-inf")
        self._in_place: deque[np.ndarray] = deque(maxlen=_IN_PLACE)
        self._noted = False  # an action was noted in place of the policy's at this tick

    def tick(self) -> None:
        """Begin a tick, at which no action is executed in place of the policy's yet."""
        self._noted = False

    def note_in_place(self, action: np.ndarray) -> None:
        """Note an action, (D,), that is executed in place of the policy's; the next request says so."""
        self._in_place.append(action)
        self._noted = True

    def heard(self, answer: Act) -> None:
        """Note whether a viewer watches, as an answer of the policy says."""
        if answer.info.pop(WATCHED, False):
            self._watched_until = time.monotonic() + _WATCHED_S

    def note(self, act: Act, executed: int) -> Act:
        """Note the action of a tick, (D,), and return it; `executed` counts those of the policy, with this one."""
        reason = act.info.get(SAFE)
        if reason is None:
            self._rows.append((executed - 1, act.action.copy()))  # the caller may change its own
            self._age_ms = act.info.get(AGE_MS)
            self._safe = ""
        else:
            self._note_safe(reason)
        return act

    def interrupt(self, reason: str) -> None:
        """Note that the action of this tick was not executed, since the robot was stopped or moved."""
        if self._noted:
            self._in_place.pop()
            self._noted = False
        if not self._safe:
            if self._rows:
                self._rows.pop()
            self._note_safe(reason)

    def failed(self, error: VLAgentsError) -> Held:
        """Note a request without an answer; return why the ticks have no action."""
        self._late += isinstance(error, DeadlineExceeded)
        return unanswered(error)

    def report(self, executed: int, agent: Agent) -> dict[str, Any]:
        """Return what the next request states.

        Args:
            executed: The number of the policy's actions that were executed before its observation.
            agent: The policy; a `RemoteAgent` knows how often it has connected again.

        Returns:
            `EXECUTED`, if other actions than the policy's were executed; while the server is watched also `PLAYED`. Its
            entries are `step`: `executed`, the step for which the first row of the answer is; `rows`: (n, D) float32,
            the policy's actions that were executed since the request before; `steps`: (n,) int64, their steps;
            `age_ms`: the age of the observation from which the last one was computed, when it was executed; `safe`: the
            reason of the last tick's safe action, "" if it had one of the policy's; and of the episode `safe_ticks`,
            `safe_spells` (runs of such ticks), `late` (requests without an answer in time), and `reconnects`.
        """
        stated: dict[str, Any] = {EXECUTED: np.stack(self._in_place)} if self._in_place else {}
        self._in_place.clear()
        if time.monotonic() > self._watched_until:
            return stated
        rows, self._rows = self._rows, deque(maxlen=_ROWS)
        played = {
            "step": executed,
            "steps": np.array([step for step, _ in rows], np.int64),
            "rows": np.stack([row for _, row in rows]) if rows else np.zeros((0, 0), np.float32),
            "age_ms": self._age_ms,
            "safe": self._safe,
            "safe_ticks": self._safe_ticks,
            "safe_spells": self._spells,
            "late": self._late,
            "reconnects": agent.reconnects,
        }
        return {**stated, PLAYED: played}

    def _note_safe(self, reason: str) -> None:
        self._spells += not self._safe
        self._safe_ticks += 1
        self._safe = reason
