"""The choice of `tune` among the measured settings, for a goal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.serve.config.deployment import BatchArgs

_BETTER = 1.05  # factor by which a variant must be better than the file's own settings to replace them


class GoalMissed(VLAgentsError):
    """No measured settings reach the goal; the message has the nearest."""


@dataclass(frozen=True, slots=True)
class TuningGoal:
    """The goal of `tune`: the most actions per second, or the most robots whose round trips are short enough."""

    kind: Literal["throughput", "robots"]
    p99_ms: float | None = None  # for robots: upper bound of the 99th percentile of round trips

    def __post_init__(self) -> None:
        if self.kind == "robots" and self.p99_ms is None:
            raise ConfigError("--for robots: got no --p99-ms, want the longest round trip that your robots bear, ms")
        if self.kind == "throughput" and self.p99_ms is not None:
            raise ConfigError("--p99-ms: is for --for robots; leave it out")


@dataclass(frozen=True, slots=True)
class Variant:
    """The file's own settings of the policy, or changes to them."""

    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The changes in words, without the batch sizes, which have their own column in the table."""
        shown = {key: value for key, value in self.changes.items() if key != "batch_sizes"}
        words = [f"{key}: {str(value).lower() if isinstance(value, bool) else value}" for key, value in shown.items()]
        return ", ".join(words) or "own settings"


@dataclass(frozen=True, slots=True)
class MeasuredPoint:
    """The figures of one variant and one number of sessions, which equals its batch size."""

    variant: Variant
    sessions: int
    actions_per_s: float
    round_trip_ms: float  # the median
    p99_ms: float
    peak_mib: float
    difference: float  # largest difference from the actions of the file's own settings, as a share of their range

    def reaches(self, goal: TuningGoal) -> bool:
        """Return whether round trips are short enough for robots, if that is the goal."""
        return goal.p99_ms is None or self.p99_ms <= goal.p99_ms


def sessions(number: int) -> str:
    """Return a number of sessions in words."""
    return f"{number} session{'s' if number > 1 else ''}"


def choose(points: Sequence[MeasuredPoint], goal: TuningGoal) -> MeasuredPoint:
    """Choose the best point for a goal.

    A variant must be 5 % better than one with fewer changes, or serve more robots.
    """
    reaching = [point for point in points if point.reaches(goal)]
    if not reaching:
        raise GoalMissed(_nearest(points, goal))
    variants = sorted({point.variant.name: point.variant for point in reaching}.values(), key=lambda v: len(v.changes))
    reached = lambda point: point.actions_per_s if goal.kind == "throughput" else point.sessions  # noqa: E731
    best, *others = (max((one for one in reaching if one.variant is variant), key=reached) for variant in variants)
    for other in others:
        if _is_better(other, best, goal):
            best = other
    return best


def default_point(points: Sequence[MeasuredPoint], goal: TuningGoal, max_size: int) -> MeasuredPoint | None:
    """Return the figures of the unchanged file; None if they were not measured, or miss the goal."""
    own = [point for point in points if not point.variant.changes and point.sessions <= max_size]
    if goal.kind == "throughput":
        own = [point for point in own if point.sessions == max_size]
    return max((one for one in own if one.reaches(goal)), key=lambda point: point.sessions, default=None)


def chosen_settings(chosen: MeasuredPoint, batch: BatchArgs, fixed: Sequence[int] | None) -> dict[str, dict[str, Any]]:
    """Return the settings of a deployment file to change, by section and key below `args`."""
    config, queue = dict(chosen.variant.changes), dict[str, Any]()
    sizes = chosen.variant.changes.get("batch_sizes", fixed)
    if sizes and sizes[-1] > chosen.sessions:
        config["batch_sizes"] = [*(size for size in sizes if size < chosen.sessions), chosen.sessions]
    if chosen.sessions != batch.max_size and batch.sizes is not None:
        queue["sizes"] = [size for size in batch.sizes if size <= chosen.sessions]
    elif chosen.sessions != batch.max_size:
        queue["max_size"] = chosen.sessions
    return {section: values for section, values in (("config", config), ("batch", queue)) if values}


def figures(points: Sequence[MeasuredPoint]) -> list[list[str]]:
    """Return a table of the measurements, with its header as the first row."""
    rows = [["settings", "sessions", "actions/s", "round trip ms", "p99 ms", "peak MiB", "actions off by"]]
    for one in points:
        numbers = [f"{one.actions_per_s:.1f}", f"{one.round_trip_ms:.1f}", f"{one.p99_ms:.1f}", f"{one.peak_mib:.0f}"]
        rows.append([one.variant.name, str(one.sessions), *numbers, f"{one.difference:.3%}"])
    return rows


def _is_better(one: MeasuredPoint, other: MeasuredPoint, goal: TuningGoal) -> bool:
    if goal.kind == "throughput":
        return one.actions_per_s > _BETTER * other.actions_per_s
    return (one.sessions, 0.0) > (other.sessions, one.p99_ms * _BETTER - other.p99_ms)


def _nearest(points: Sequence[MeasuredPoint], goal: TuningGoal) -> str:
    if not points:
        return "no settings could be measured"
    found = min(points, key=lambda point: point.p99_ms)
    return (
        f"--p99-ms: got {goal.p99_ms}; the shortest p99 of a round trip was {found.p99_ms:.1f} ms, with "
        f"{sessions(found.sessions)} and {found.variant.name}; raise --p99-ms, or use a faster machine or model"
    )
