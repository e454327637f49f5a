"""What a robot needs of its policy to be served in time: its service level objective (SLO).

A control loop sends it with its reset, as the option `slo`; the server compares it with what the
replica can do, and answers in the reset's info (`SLO` in `vlagents_ray.interface`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from vlagents_ray.errors import ConfigError, printable, shown
from vlagents_ray.naming import did_you_mean

# Limits of a rate, Hz, of an age, ms, and of a number of rows: the server computes with their
# reciprocals and products.
_LEAST, MOST = 1e-6, 1e9
_REASON_CHARACTERS = 1000  # of a server's reason why a robot is not served in time
SHARE = 0.98
"""The share of ticks with an action in time that a robot needs if it states none."""


@dataclass(frozen=True, slots=True)
class Slo:
    """The service level objective of a robot.

    Args:
        hz: The rate of its control loop, Hz.
        age_ms: The largest age of an executed action, from the capture of its observation, ms;
            None: any.
        share: The least share in time: of the ticks at which the policy was to act, those with an
            action in time, above 0 and at most 1.
        rows: The rows of a chunk that it executes at most; None: all of them.

    Raises:
        ConfigError: A value is not a number, or is out of its range.
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
                "it out if actions of any age will do"
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
        """Return the objective that a message or a file states.

        Args:
            value: A JSON object with `hz`, and optionally `age_ms`, `share` and `rows`.

        Raises:
            ConfigError: It is not such an object, or has a wrong value.
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
        """Return the objective as a JSON object, without what is None."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}


def read_answer(answer: object) -> dict[str, Any]:
    """Return a server's answer to an SLO: `load`, `in_time`, and a `reason` if it is not in time.

    It is empty if there is none, or if it has another form: a run does not depend on it. The reason
    is a text of another party, and has no line feeds, with which it could forge a line of a log.
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
    except OverflowError:  # an integer without a float
        return False
