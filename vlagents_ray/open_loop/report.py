"""The result of an open-loop evaluation as files: JSON, and a page with pictures that needs no network."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from jinja2 import Environment
from markupsafe import Markup

from vlagents_ray.evaluate.artifacts.storage import storing, whole
from vlagents_ray.evaluate.report import charts
from vlagents_ray.open_loop.replay import OpenLoopResult

JSON_FILE, PAGE_FILE = "open_loop.json", "open_loop.html"
_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 460, 240, 52, 24  # of a chart, and of its axes
_MOST_STEPS = 64  # columns of the map
_LEVELS = 5  # of colour in the map


@dataclass(frozen=True, slots=True)
class LineChart:
    """Lines over a common axis, as paths."""

    title: str
    x_label: str
    lines: list[tuple[str, str]]  # name, path
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """The error by joint and step, each cell with its share of the largest."""

    steps: list[int]
    rows: list[tuple[str, list[tuple[str, float]]]]  # joint, (number, share in [0, 1])


def write_files(result: OpenLoopResult, policy: str, folder: Path) -> list[Path]:
    """Write `open_loop.json` and `open_loop.html` into a folder, which is made; return both paths."""
    document = {"policy": policy, **result.to_json()}
    with storing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        texts = {JSON_FILE: json.dumps(document, indent=2, ensure_ascii=False), PAGE_FILE: _page(result, policy)}
        for name, text in texts.items():
            with whole(folder / name) as part:
                part.write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def _page(result: OpenLoopResult, policy: str) -> str:
    by_step = result.to_json()["by_step"]
    errors = [
        ("mean absolute", [one["mae"] for one in by_step]),
        ("root mean square", [one["rmse"] for one in by_step]),
    ]
    drawn = np.array(result.drawn) if result.drawn else np.zeros((0, 2, len(result.joints)))  # (N, 2, D)
    return (
        _templates()
        .get_template("open_loop.html.j2")
        .render(
            result=result.to_json(),
            policy=policy,
            horizon=line_chart("Error by step of the horizon", "step of the chunk", errors, 0.0),
            map=_map(result),
            joints=[
                line_chart(name, "frame", [("recorded", drawn[:, 0, i]), ("policy", drawn[:, 1, i])])
                for i, name in enumerate(result.joints)
            ],
        )
    )


def line_chart(
    title: str, x_label: str, series: Sequence[tuple[str, Sequence[float] | np.ndarray]], floor: float = math.inf
) -> LineChart:
    """Draw series of numbers at 0, 1, 2, … on common axes, of which the upright one begins at `floor` at the latest."""
    values = np.concatenate([np.asarray(numbers, float) for _, numbers in series]) if series else np.zeros(1)
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    low = min(low, floor)
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    last = max(1, max((len(numbers) for _, numbers in series), default=1) - 1)

    def x(value: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - 8) * value / last

    def y(value: float) -> float:
        return 8 + (_HEIGHT - _BOTTOM - 8) * (high - value) / (high - low)

    def path(numbers: Sequence[float] | np.ndarray) -> str:
        if len(numbers) == 1:  # one point is a short line
            return f"M{x(0):.1f} {y(numbers[0]):.1f}h6"
        return "M" + "L".join(f"{x(i):.1f} {y(value):.1f}" for i, value in enumerate(numbers))

    return LineChart(
        title,
        x_label,
        [(name, path(numbers)) for name, numbers in series if len(numbers)],
        [(x(tick), charts.short(tick)) for tick in charts.ticks(0, last) if tick == int(tick)],
        [(y(tick), charts.short(tick)) for tick in charts.ticks(low, high, 4)],
    )


def _map(result: OpenLoopResult) -> ErrorMap:
    mean = result.table.mean()
    steps = list(range(0, len(mean), max(1, -(-len(mean) // _MOST_STEPS))))
    largest = float(mean.max(initial=0)) or 1.0
    return ErrorMap(
        steps,
        [
            (name, [(f"{mean[step, i]:.3g}", round(_LEVELS * mean[step, i] / largest) / _LEVELS) for step in steps])
            for i, name in enumerate(result.joints)
        ],
    )


@cache
def _templates() -> Environment:
    env = charts.templates(__package__ or "")
    css = (files(charts.__package__ or "") / "report.css").read_text("utf-8").strip()
    env.globals.update(css=Markup(css), width=_WIDTH, height=_HEIGHT, left=_LEFT, bottom=_BOTTOM)  # noqa: S704 - ours
    return env
