"""Draw the pictures of an observation's path to the policy: `python docs/pictures/flows.py` writes
them. Each text has its own background colour, so that one file is readable on light and on dark
pages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

FOLDER = Path(__file__).parent
_CLIENT, _TRANSPORT, _SERVER, _POLICY, _LINE = "#3949ab", "#546e7a", "#00695c", "#a0430a", "#8490a3"
_BOX_HEIGHT, _ROW_HEIGHT, _TOP = 58, 84, 52

Box = tuple[str, str, str]  # title, explanation, colour


def overview() -> str:
    """Return the picture of clients, transports and the replicas of a deployment."""
    clients = [
        ("robots", "control loop, chunk player, guard", _CLIENT),
        ("simulators", "evaluations, rollouts: Ray actors", _CLIENT),
        ("other clients", "openpi, GR00T, LeRobot, …", _CLIENT),
        ("learner", "pushes new weights", _CLIENT),
    ]
    transports = [
        ("shared memory", "same machine", _TRANSPORT),
        ("plasma", "same Ray node", _TRANSPORT),
        ("WebSocket, HTTP", "any machine", _TRANSPORT),
    ]
    replicas = [
        ("router, autoscaler", "least load, robots in time", _SERVER),
        ("replica on GPU 1", "sessions, batch queue, policy", _POLICY),
        ("replica on GPU 2", "sessions, batch queue, policy", _POLICY),
        ("… replica on GPU N", "sessions move between replicas", _POLICY),
    ]
    parts = [
        *_column(20, 250, "clients", clients, rows=4),
        *_column(360, 180, "transports", transports, rows=4),
        *_column(630, 250, "Ray Serve", replicas, rows=4),
    ]
    for row in range(4):
        y = _box_top(row) + _BOX_HEIGHT // 2
        parts.append(_arrow(298, y, 340, _middle(rows=4)))
        parts.append(_arrow(578, _middle(rows=4), 610, y))
    return _svg("Many clients share the replicas of a policy", 900, 4, parts)


def shared_memory() -> str:
    """Return the picture of a request through shared memory: the file between the processes."""
    client = [("RemoteAgent", "client/transports/shm", _CLIENT)]
    between = [
        ("memory file", "raw pixels, mapped by both", _TRANSPORT),
        ("Unix socket", "100 bytes and a descriptor", _TRANSPORT),
    ]
    server = [("the policy's thread", "serve/endpoints/shm", _POLICY)]
    parts = [
        *_column(20, 210, "client process", client, rows=2),
        *_column(330, 220, "shared", between, rows=2),
        *_column(650, 230, "replica process", server, rows=2),
    ]
    for row in range(2):
        y = _box_top(row) + _BOX_HEIGHT // 2
        parts.append(_arrow(248, _middle(rows=2), 312, y))
        parts.append(_arrow(568, y, 628, _middle(rows=2)))
    return _svg("Shared memory: same machine, same user", 900, 2, parts)


PICTURES: dict[str, Callable[[], str]] = {"flow": overview, "shared_memory": shared_memory}


def _svg(title: str, width: int, rows: int, parts: Sequence[str]) -> str:
    height = _box_top(rows - 1) + _BOX_HEIGHT + 22
    head = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">',
        '<g font-size="16" font-family="system-ui, sans-serif" text-anchor="middle">',
        f"<title>{escape(title)}</title>",
        (
            '<marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            'orient="auto">'
        ),
        f'<path d="M0 0L8 4L0 8z" fill="{_LINE}"/></marker>',
    ]
    return "\n".join([*head, *parts, "</g></svg>"]) + "\n"


def _column(x: int, width: int, label: str, boxes: Sequence[Box], *, rows: int) -> list[str]:
    """Return a group of boxes with a label, centred vertically in a picture of `rows` rows."""
    offset = (rows - len(boxes)) * _ROW_HEIGHT // 2
    top = _box_top(0) + offset
    height = (len(boxes) - 1) * _ROW_HEIGHT + _BOX_HEIGHT
    parts = [
        (
            f'<rect x="{x - 14}" y="{top - 20}" width="{width + 28}" height="{height + 34}" '
            f'rx="14" fill="none" stroke="{_LINE}" stroke-width="1.5" stroke-dasharray="5 4"/>'
        ),
        *_pill(x + width // 2, top - 20, label),
    ]
    for row, (title, explanation, colour) in enumerate(boxes):
        parts += _box(x, top + row * _ROW_HEIGHT, width, title, explanation, colour)
    return parts


def _box_top(row: int) -> int:
    return _TOP + row * _ROW_HEIGHT


def _middle(*, rows: int) -> int:
    """Return the vertical middle of a picture."""
    return (_box_top(0) + _box_top(rows - 1) + _BOX_HEIGHT) // 2


def _box(x: int, y: int, width: int, title: str, explanation: str, colour: str) -> list[str]:
    middle = x + width // 2
    return [
        f'<rect x="{x}" y="{y}" width="{width}" height="{_BOX_HEIGHT}" rx="9" fill="{colour}"/>',
        f'<text x="{middle}" y="{y + 25}" fill="#fff" font-weight="600">{escape(title)}</text>',
        f'<text x="{middle}" y="{y + 45}" fill="#fff" font-size="13">{escape(explanation)}</text>',
    ]


def _pill(x: int, y: int, text: str) -> list[str]:
    width = 9 * len(text) + 18
    return [
        (
            f'<rect x="{x - width // 2}" y="{y - 10}" width="{width}" height="20" rx="10" '
            f'fill="{_TRANSPORT}"/>'
        ),
        f'<text x="{x}" y="{y + 5}" fill="#fff" font-size="14">{escape(text)}</text>',
    ]


def _arrow(x1: int, y1: int, x2: int, y2: int) -> str:
    return (
        f'<path d="M{x1} {y1}L{x2} {y2}" stroke="{_LINE}" stroke-width="2.5" '
        'marker-end="url(#tip)"/>'
    )


if __name__ == "__main__":
    for name, picture in PICTURES.items():
        (FOLDER / f"{name}.svg").write_text(picture())
