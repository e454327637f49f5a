"""Draw the success of the reference policy over the delay of its answers.

`python docs/pictures/curves.py` reads `examples/reference/delays.json`, and draws a line for each
way to execute late answers. The picture has a background, so that one file is readable on light
and on dark pages.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_WIDTH, _HEIGHT, _LEFT, _TOP, _RIGHT, _BOTTOM = 900, 430, 78, 56, 240, 60
_BEFORE = "tabletop, late rows as they are (commit 2c1bb1c2)"
# For each line: its name, the table and the mode in the file, and its colour.
_LINES = (
    ("without noise", "tabletop, with `initial_noise: 0`", "async, grips at once", "#6a1b9a"),
    ("async (default)", "tabletop", "async", "#00695c"),
    ("async, grips at once", "tabletop", "async, grips at once", "#3949ab"),
    ("stop and wait", "tabletop", "stop and wait", "#546e7a"),
    ("async before", _BEFORE, "async", "#a0430a"),
)
_LEAST = 40  # %, the lower end of the vertical axis


def success_by_delay(tables: Mapping[str, Any]) -> str:
    """Return the picture of the tables of `benchmarks.delays`, as SVG."""
    rows = tables["tabletop"]["rows"]
    delays = sorted({int(row["delay"]) for row in rows if row["delay"].isdigit()})
    longest = delays[-1]

    def x(delay: float) -> float:
        return _LEFT + delay / longest * (_WIDTH - _LEFT - _RIGHT)

    def y(percent: float) -> float:
        share = (max(percent, _LEAST) - _LEAST) / (100 - _LEAST)
        return _TOP + (1 - share) * (_HEIGHT - _TOP - _BOTTOM)

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">',
        '<g font-size="15" font-family="system-ui, sans-serif" fill="#263238">',
        "<title>Success of the reference policy by the delay of its answers</title>",
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" rx="12" fill="#ffffff"/>',
        f'<text x="{_LEFT}" y="30" font-weight="600">Episodes solved, %, by delay in rows</text>',
    ]
    for percent in range(_LEAST, 101, 10):
        parts += [
            f'<path d="M{_LEFT} {y(percent):.1f}H{_WIDTH - _RIGHT}" stroke="#cfd8dc"/>',
            f'<text x="{_LEFT - 10}" y="{y(percent) + 5:.1f}" text-anchor="end">{percent}</text>',
        ]
    for delay in delays:
        parts.append(
            f'<text x="{x(delay):.1f}" y="{_HEIGHT - 32}" text-anchor="middle">{delay}</text>'
        )
    parts.append(
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2:.0f}" y="{_HEIGHT - 12}" text-anchor="middle">'
        "delay of an answer, rows (100 ms each)</text>"
    )

    below = 0.0  # the lowest place that a label of an earlier line has
    ends = []
    for name, table, mode, colour in _LINES:
        points = list(_points(tables[table]["rows"], mode))
        path = "L".join(f"{x(delay):.1f} {y(rate):.1f}" for delay, rate, _, _ in points)
        parts.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="3"/>')
        for delay, rate, low, high in points:
            parts += [
                (
                    f'<path d="M{x(delay):.1f} {y(low):.1f}V{y(high):.1f}" stroke="{colour}" '
                    'stroke-width="1.5"/>'
                ),
                f'<circle cx="{x(delay):.1f}" cy="{y(rate):.1f}" r="4.5" fill="{colour}"/>',
            ]
        ends.append((y(points[-1][1]), x(points[-1][0]), name, colour))
    for end, right, name, colour in sorted(ends):
        below = max(end + 5, below + 20)
        parts.append(
            f'<text x="{right + 14:.1f}" y="{below:.1f}" fill="{colour}" font-weight="600">'
            f"{escape(name)}</text>"
        )
    return "\n".join([*parts, "</g></svg>"]) + "\n"


def _points(
    rows: Sequence[Mapping[str, Any]], mode: str
) -> Iterator[tuple[int, float, float, float]]:
    """Yield the delay in rows of each row of a mode with one, its rate, and its interval, %."""
    for row in rows:
        if row["mode"] == mode and row["delay"].isdigit():
            low, high = row["interval_95"]
            rate = row["solved"] / row["episodes"]
            yield int(row["delay"]), 100 * rate, 100 * low, 100 * high


if __name__ == "__main__":
    found = json.loads((ROOT / "examples/reference/delays.json").read_text())
    (Path(__file__).parent / "success.svg").write_text(success_by_delay(found))
