"""Two files of figures side by side, as `bench … --json` writes them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError

_NAMES = ("way", "clients", "batch")  # keys of which one names a row of a list
_COMPARED = ("_ms", "_per_s", "_mib", "of_ideal", "mean_batch", "_bytes", "wall_s", "per_minute")  # ends of their names
_SAME = ("cpu", "cores", "memory_gb", "kernel")  # of the machine


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """One figure of both files."""

    name: str  # its place in the files, with spaced slashes
    old: float
    new: float
    overlap: bool | None = None  # whether the 95 % intervals of both overlap; None: they have none

    @property
    def ratio(self) -> float:
        """The new figure over the old one; 1 if both are the same, also if both are 0."""
        if self.new == self.old:
            return 1.0
        return self.new / self.old if self.old else float("inf")


@dataclass(frozen=True, slots=True)
class FigureComparison:
    """What two files have in common, and in what they differ besides figures."""

    figures: tuple[ComparedFigure, ...]
    only_old: tuple[str, ...]  # figures that one file alone has
    only_new: tuple[str, ...]
    circumstances: tuple[str, ...]  # differences of machines and versions, a sentence each


def compare_figures(old: Mapping[str, Any], new: Mapping[str, Any]) -> FigureComparison:
    """Compare the figures of two measurements, in the order of the new one."""
    before, after = dict(_figures(old)), dict(_figures(new))
    figures = [
        ComparedFigure(name, before[name][0], value, _overlap(before[name][1], interval))
        for name, (value, interval) in after.items()
        if name in before
    ]
    return FigureComparison(
        tuple(figures),
        tuple(name for name in before if name not in after),
        tuple(name for name in after if name not in before),
        tuple(_circumstances(old, new)),
    )


def read_figures(file: Path) -> dict[str, Any]:
    """Read a file of figures; raises `ConfigError` if it is none."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read ({error}); want what `bench … --json FILE` wrote") from error
    if not isinstance(found, dict) or not any(True for _ in _figures(found)):
        raise ConfigError(f"{file}: holds no figures; want what `bench … --json FILE` wrote")
    return found


def _figures(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, tuple[float, Any]]]:
    """Yield name, value and 95 % interval of each figure below a node of JSON."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            if isinstance(value, int | float) and not isinstance(value, bool) and key.endswith(_COMPARED):
                interval = node.get(f"ci95{key.removeprefix('median')}") if key.startswith("median") else None
                yield " / ".join((*path, key)), (float(value), interval)
            elif isinstance(value, Mapping | list):
                yield from _figures(value, (*path, key))
    elif isinstance(node, list):
        for one in node:
            if isinstance(one, Mapping) and (name := next((key for key in _NAMES if key in one), None)) is not None:
                label = str(one[name]) if name == "way" else f"{name} {one[name]}"
                yield from _figures(one, (*path, label))


def _overlap(old: Any, new: Any) -> bool | None:
    if old is None or new is None:
        return None
    return bool(old[0] <= new[1] and new[0] <= old[1])


def _circumstances(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for part, names in (("machine", _SAME), ("versions", None)):
        before, after = old.get(part) or {}, new.get(part) or {}
        if not before or not after:
            continue
        for name in names or sorted({*before, *after}):
            if before.get(name) != after.get(name):
                yield f"{name}: {before.get(name, 'none')} before, {after.get(name, 'none')} now"
