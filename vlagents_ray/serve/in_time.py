"""Whether robots had their actions in time, according to the reports in their requests.

A chunk player on a robot adds three values to each request: the number of ticks since the last
request at which the policy had to act, the number of these ticks without a row of an answer
(*starved ticks*), and the age of the last executed action. The entries in the requests' info are
untrusted. `RobotReport.of` checks them, and a session keeps a fixed number of values regardless of
how often its robot reports.

If the success of the policy's checkpoint was measured by delay (`vlagents_ray.success`), an age is
*within the tolerance* if the policy solved its tasks with actions of that age.
"""

from __future__ import annotations

import math
import reprlib
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import EXECUTED_AGE, TICKS
from vlagents_ray.success import SuccessCurve

WINDOW_S = 10  # time over which shares and ages are computed, s
# Maximum number of ticks, and maximum age, in one report. The report of a robot that was offline
# for weeks stays below these limits, since the robot would otherwise be rejected forever.
_MOST_TICKS = 2**31
_MOST_AGE_MS = 2.0**31
_AGES = 128  # maximum number of ages that a session keeps


class RobotReport(NamedTuple):
    """The report of a robot in one request."""

    ticks: int  # ticks since the last request at which the policy had to act
    starved: int  # number of these ticks without a row of an answer
    age_ms: float | None  # age of the last executed action, ms; None if there was none
    # Whether the policy tolerates this age; None if it is not known, or there is no age.
    is_tolerated: bool | None = None

    @classmethod
    def of(cls, info: Mapping[str, Any]) -> RobotReport | None:
        """Return the report in the info of an observation; None if there is none.

        Raises:
            InvalidInput: An entry has another type than a chunk player sends, or is out of range.
        """
        if TICKS not in info and EXECUTED_AGE not in info:
            return None

        ticks = info.get(TICKS, (0, 0))
        is_pair = isinstance(ticks, (list, tuple)) and len(ticks) == 2
        if not is_pair or any(type(number) is not int for number in ticks):
            raise InvalidInput(f"info[{TICKS!r}]: expected two integers, got {reprlib.repr(ticks)}")
        all_ticks, starved = ticks
        if not 0 <= starved <= all_ticks <= _MOST_TICKS:
            raise InvalidInput(
                f"info[{TICKS!r}]: expected 0 <= starved ticks <= ticks <= {_MOST_TICKS}, got "
                f"{reprlib.repr(ticks)}"
            )

        age_ms = info.get(EXECUTED_AGE)
        if age_ms is None:
            return cls(all_ticks, starved, None)
        # A NaN fails the comparison.
        if type(age_ms) not in (int, float) or not 0 <= age_ms <= _MOST_AGE_MS:
            raise InvalidInput(
                f"info[{EXECUTED_AGE!r}]: expected a number in [0, {_MOST_AGE_MS:g}], got "
                f"{reprlib.repr(age_ms)}"
            )
        return cls(all_ticks, starved, float(age_ms))

    def compared(self, tolerated_age_ms: float | None) -> RobotReport:
        """Return the report with a comparison of its age and the largest age that the policy
        tolerates, ms; None if that is not known.
        """
        if self.age_ms is None or tolerated_age_ms is None:
            return self
        return self._replace(is_tolerated=self.age_ms <= tolerated_age_ms)


def tolerated_age_ms(curves: Iterable[SuccessCurve]) -> float | None:
    """Return the largest age of an executed action that a policy tolerates, ms; None without
    curves.

    With the tolerated delay d*, an answer's first row has the age of d* ticks, and its last row is
    executed when the next answer arrives. If a policy was measured in several environments, the
    smallest age counts, as a server does not know the task. If it was measured with several
    settings, the largest one does: that of the settings that one would use.

    Args:
        curves: The measured success of the policy's checkpoint.
    """
    ages_ms: dict[tuple[str, str], float] = {}  # keys: mode and settings
    for curve in curves:
        execute = curve.settings.get("execute")
        if execute is None and curve.mode == "open_loop":
            continue  # all rows of a chunk, whose number is not known
        delay = curve.tolerated
        rows = execute or 1
        if curve.mode != "open_loop":  # the next request waits for the answer
            rows = max(rows, delay + 1)
        age_ms = 1e3 * (delay + rows) / curve.hz
        key = curve.mode, repr(sorted(curve.settings.items()))
        ages_ms[key] = min(age_ms, ages_ms.get(key, math.inf))

    # Robots that wait for each answer tolerate any delay. By default, robots do not wait.
    moving = [age_ms for (mode, _), age_ms in ages_ms.items() if mode == "async"]
    return max(moving or ages_ms.values(), default=None)


class RobotTimes:
    """The ticks and the ages that the robot of one session reports. Thread-safe."""

    def __init__(self) -> None:
        """Create the record of a session, without reports."""
        self._lock = threading.Lock()
        # Number, ticks and starved ticks of each second, oldest first.
        self._seconds: deque[tuple[int, int, int]] = deque(maxlen=WINDOW_S + 1)
        # Time, s, age, ms, and whether the policy tolerates the age.
        self._ages: deque[tuple[float, float, bool | None]] = deque(maxlen=_AGES)

    def add(self, report: RobotReport, now: float) -> None:
        """Add a report that arrived at `now`, s."""
        second = math.floor(now)
        with self._lock:
            ticks, starved = report.ticks, report.starved
            if self._seconds and self._seconds[-1][0] >= second:
                second, ticks_before, starved_before = self._seconds.pop()
                ticks += ticks_before
                starved += starved_before
            self._seconds.append((second, ticks, starved))
            if report.age_ms is not None:
                self._ages.append((now, report.age_ms, report.is_tolerated))

    def lately(self, now: float) -> TimeShare:
        """Return statistics about the service to the robot in the last `WINDOW_S` seconds before
        `now`, s.
        """
        oldest = math.floor(now) - WINDOW_S
        all_ticks = all_starved = 0
        with self._lock:
            for second, ticks, starved in self._seconds:
                if second > oldest:
                    all_ticks += ticks
                    all_starved += starved
            ages_ms = [age_ms for when, age_ms, _ in self._ages if when > now - WINDOW_S]
        return TimeShare.from_ages(all_ticks, all_starved, ages_ms)

    def within_tolerance(self, now: float) -> float | None:
        """Return the share of the ages in the last `WINDOW_S` seconds before `now`, s, that the
        policy tolerates, in [0, 1]; None if it is not known.
        """
        with self._lock:
            are_tolerated = [
                is_tolerated
                for when, _, is_tolerated in self._ages
                if when > now - WINDOW_S and is_tolerated is not None
            ]
        return sum(are_tolerated) / len(are_tolerated) if are_tolerated else None
