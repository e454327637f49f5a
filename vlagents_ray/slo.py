"""The service level objective (SLO) of a robot: the timeliness that it needs from its policy.

A control loop sends the SLO with `reset`, as the option `slo`. The server estimates whether the
replica can meet it, and returns the result in the info of the reset (`SLO` in
`vlagents_ray.interface`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from vlagents_ray.errors import ConfigError, printable, shown
from vlagents_ray.naming import did_you_mean

# Limits of a rate (Hz), an age (ms) and a number of rows, with whose reciprocals and products the
# server computes.
_LEAST, MOST = 1e-6, 1e9
_REASON_CHARACTERS = 1000  # maximum length of a server's reason why a robot is not served in time
SHARE = 0.98
"""The default share of ticks with an action in time that a robot needs."""


@dataclass(frozen=True, slots=True)
class Slo:
    """The service level objective of a robot.

    Args:
        hz: The rate of its control loop, Hz.
        age_ms: The largest acceptable age of an executed action, measured from the capture of its
            observation, ms; None: no limit.
        share: The smallest acceptable share of ticks with an action in time, among the ticks that
            need an action of the policy; above 0 and at most 1.
        rows: The maximum number of rows of a chunk that the robot executes; None: all.

    Raises:
        ConfigError: A value is not a number, or is out of range.
    """

    hz: float
    age_ms: float | None = None
    share: float = SHARE
    rows: int | None = None

    def __post_init__(self) -> None:
        if not (_is_number(self.hz) and _LEAST <= self.hz <= MOST):
            raise ConfigError(
                f"slo.hz: expected a rate from {_LEAST:g} to {MOST:g} Hz, got {shown(self.hz)}; "
                "give the rate of the control loop"
            )
        if self.age_ms is not None and not (
            _is_number(self.age_ms) and _LEAST <= self.age_ms <= MOST
        ):
            raise ConfigError(
                f"slo.age_ms: expected {_LEAST:g} to {MOST:g} ms, got {shown(self.age_ms)}; leave "
                f"it out if actions may have any age"
            )
        if not (_is_number(self.share) and 0 < self.share <= 1):
            raise ConfigError(
                f"slo.share: expected a share above 0 and at most 1, got {shown(self.share)}; give "
                f"{SHARE} for 98 % of the ticks"
            )

        if self.rows is not None and not (type(self.rows) is int and 1 <= self.rows <= MOST):
            raise ConfigError(
                f"slo.rows: expected a whole number from 1 to {MOST:g}, got {shown(self.rows)}; "
                "leave it out if whole chunks are executed"
            )

    @classmethod
    def from_json(cls, value: object) -> Slo:
        """Read an objective from a message or a file.

        Args:
            value: A JSON object with `hz`, and optionally `age_ms`, `share` and `rows`.

        Raises:
            ConfigError: The value is not such an object, or contains a wrong value.
        """
        if not isinstance(value, Mapping):
            raise ConfigError(
                f'slo: expected an object such as {{"hz": 10}}, got {shown(value)}; give at least '
                "hz"
            )

        names = [field.name for field in fields(cls)]
        for name in value:
            if name not in names:
                hint = did_you_mean(str(name)[:80], names) or "; leave it out"
                raise ConfigError(f"slo: expected only {names}, got {shown(name)}{hint}")
        if "hz" not in value:
            raise ConfigError(
                f"slo: expected hz, got {shown(value)}; give the rate of the control loop"
            )
        return cls(**value)

    def to_json(self) -> dict[str, Any]:
        """Return the objective as a JSON object, without the fields that are None."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


def read_answer(answer: object) -> dict[str, Any]:
    """Return a server's answer to an SLO: `load`, `in_time`, and a `reason` if it is not in time.

    The result is empty if the server sent no answer, or one of another form, since a run does not
    depend on the answer. Line feeds are removed from the reason, since a server could forge lines
    of a log with them.
    """
    in_time = answer.get("in_time") if isinstance(answer, Mapping) else None
    if not isinstance(answer, Mapping) or not isinstance(in_time, bool):
        return {}

    load = answer.get("load")
    told: dict[str, Any] = {"load": load if _is_number(load) else None, "in_time": in_time}
    if not in_time:
        reason = answer.get("reason", "")
        text = reason[:_REASON_CHARACTERS] if isinstance(reason, str) else shown(reason)
        told["reason"] = " ".join(printable(text).split())
    return told


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number; a boolean does not count as one."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer too large for a float
        return False
