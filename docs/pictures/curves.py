"""Draw the success of the reference policy over the delay of its answers, a line for each mode:
`python docs/pictures/curves.py` writes the picture from `examples/reference/delays.json`. It has a
background, so that one file is readable on light and on dark pages.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_WIDTH, _HEIGHT, _LEFT, _TOP, _RIGHT, _BOTTOM = 900, 430, 78, 56, 240, 60
_MODES = {
    "async": "#00695c",
    "async, grips at once": "#3949ab",
    "stop and wait": "#546e7a",
    "prefixes": "#a0430a",
}
_LEAST = 40  # %, the lower end of the vertical axis


def success_by_delay(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the picture of the rows of `benchmarks.delays`, as SVG."""
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
    for mode, colour in _MODES.items():
        points = list(_points(rows, mode))
        if not points:
            continue
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
        ends.append((y(points[-1][1]), x(points[-1][0]), mode, colour))
    for end, right, mode, colour in sorted(ends):
        below = max(end + 5, below + 20)
        parts.append(
            f'<text x="{right + 14:.1f}" y="{below:.1f}" fill="{colour}" font-weight="600">'
            f"{escape(mode)}</text>"
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
    (Path(__file__).parent / "success.svg").write_text(success_by_delay(found["tabletop"]["rows"]))
