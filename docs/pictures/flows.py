"""The pictures of an observation's way to the policy and back: `python docs/pictures/flows.py`
writes them anew.

Every text stands on a colour of its own, so that one file is readable on a light page and on a dark
one.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

FOLDER = Path(__file__).parent
_CLIENT, _WAY, _SERVER, _POLICY, _LINE = "#3949ab", "#546e7a", "#00695c", "#a0430a", "#8490a3"
_BOX_W, _BOX_H, _ROW, _TOP, _LEFT, _RIGHT, _WIDTH = 230, 58, 96, 52, 20, 430, 680

# Name of the picture -> what it shows; the client's boxes and the server's, from top to bottom,
# each with the place of its code; and what lies between the last two: title, what crosses.
FLOWS: dict[str, tuple[str, list[tuple[str, str]], list[tuple[str, str]], tuple[str, str]]] = {
    "flow": (
        "One way to the policy, and the same way back",
        [("robots, simulators", "Obs(cameras, gripper, state)"), ("chunk player", "one action a tick"),
         ("RemoteAgent", "picks the fastest way")],
        [("policy", "one forward pass for all"), ("batch queue", "robots before simulations"),
         ("session", "one robot, one environment")],
        ("4 ways", "shm, plasma, WebSocket, HTTP"),
    ),
    "shared_memory": (
        "Shared memory: same machine, same user",
        [("RemoteAgent", "client/agent"), ("memory file", "client/transports/shm")],
        [("policy", "policies/"), ("batch queue", "serve/engine, serve/queue"),
         ("shm endpoint", "serve/endpoints/shm")],
        ("Unix socket", "100 bytes and a descriptor"),
    ),
    "plasma": (
        "Plasma: same Ray node, where the Unix socket is out of reach",
        [("RemoteAgent", "client/agent"), ("object store", "client/transports/serve_handle")],
        [("policy", "policies/"), ("batch queue", "serve/engine, serve/queue"),
         ("plasma endpoint", "serve/endpoints/plasma")],
        ("plasma object", "raw pixels, one copy"),
    ),
    "websocket": (
        "WebSocket: any machine, straight to the replica",
        [("RemoteAgent", "client/agent"), ("codec", "client/transports/websocket")],
        [("policy", "policies/"), ("batch queue", "serve/engine, serve/queue"),
         ("WebSocket endpoint", "serve/endpoints/own_port")],
        ("TCP", "one frame: JPEG, PNG or raw"),
    ),
    "http": (
        "HTTP: any machine, straight to the replica or through the proxy",
        [("RemoteAgent, or curl", "client/agent"), ("HTTP transport", "client/transports/http")],
        [("policy", "policies/"), ("batch queue", "serve/engine, serve/queue"),
         ("HTTP endpoint", "serve/endpoints/http_connection")],
        ("TCP", "one frame, form or JSON"),
    ),
}  # fmt: skip


def picture(name: str) -> str:
    """The picture as SVG: a request runs down on the left, across, and up on the right; its
    reply runs back.
    """
    title, client, server, (way, crosses) = FLOWS[name]
    rows = max(len(client), len(server))
    height = _TOP + (rows - 1) * _ROW + _BOX_H + 22
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img">',
        '<g font-size="16" font-family="system-ui, sans-serif" text-anchor="middle">',
        f"<title>{escape(title)}</title>",
        (
            '<marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" '
            'orient="auto">'
        ),
        f'<path d="M0 0L8 4L0 8z" fill="{_LINE}"/></marker>',
    ]
    for x, boxes, label, colour in (
        (_LEFT, client, "client", _CLIENT),
        (_RIGHT, server, "replica (a Ray actor)", _SERVER),
    ):
        top = _y(rows, len(boxes), 0)
        parts.append(
            f'<rect x="{x - 14}" y="{top - 20}" width="{_BOX_W + 28}" height="{height - top + 14}" '
            'rx="14" fill="none" '
            f'stroke="{_LINE}" stroke-width="1.5" stroke-dasharray="5 4"/>'
        )
        parts += _pill(x + _BOX_W // 2, top - 20, label)
        for row, (name_, where) in enumerate(boxes):
            y = _y(rows, len(boxes), row)
            parts += _box(x, y, _BOX_W, name_, where, _POLICY if name_ == "policy" else colour)
            if row + 1 < len(boxes):
                down, up = (x + 85, x + 145) if x == _LEFT else (x + 145, x + 85)
                parts.append(_arrow(down, y + _BOX_H + 2, down, y + _ROW - 3))
                parts.append(_arrow(up, y + _ROW - 2, up, y + _BOX_H + 3))
    y = _y(rows, 1, 0)
    left, right, middle = _LEFT + _BOX_W, _RIGHT, (_LEFT + _BOX_W + _RIGHT) // 2
    parts.append(_arrow(left + 2, y + 20, right - 3, y + 20))
    parts.append(_arrow(right - 2, y + 40, left + 3, y + 40))
    parts += _pill(middle, y + 20, "Obs")
    parts += _pill(middle, y + 40, "Act")
    parts += _label(middle, y - 30, way, crosses)
    return "\n".join([*parts, "</g></svg>"]) + "\n"


def _y(rows: int, boxes: int, row: int) -> int:
    """Top of a box: both columns end in the same row."""
    return _TOP + (rows - boxes + row) * _ROW


def _box(x: int, y: int, width: int, title: str, where: str, colour: str) -> list[str]:
    middle = x + width // 2
    return [
        f'<rect x="{x}" y="{y}" width="{width}" height="{_BOX_H}" rx="9" fill="{colour}"/>',
        f'<text x="{middle}" y="{y + 25}" fill="#fff" font-weight="600">{escape(title)}</text>',
        f'<text x="{middle}" y="{y + 45}" fill="#fff" font-size="13">{escape(where)}</text>',
    ]


def _pill(x: int, y: int, text: str) -> list[str]:
    width = 9 * len(text) + 18
    return [
        (
            f'<rect x="{x - width // 2}" y="{y - 10}" width="{width}" height="20" rx="10" '
            f'fill="{_WAY}"/>'
        ),
        f'<text x="{x}" y="{y + 5}" fill="#fff" font-size="14">{escape(text)}</text>',
    ]


def _label(x: int, y: int, title: str, text: str) -> list[str]:
    words = text.split()
    half = (len(words) + 1) // 2
    lines = [" ".join(words[:half]), " ".join(words[half:])]
    return [
        f'<rect x="{x - 70}" y="{y - 44}" width="140" height="66" rx="9" fill="{_WAY}"/>',
        f'<text x="{x}" y="{y - 24}" fill="#fff" font-weight="600">{escape(title)}</text>',
        *(
            f'<text x="{x}" y="{y - 5 + 17 * n}" fill="#fff" font-size="13">{escape(line)}</text>'
            for n, line in enumerate(lines)
        ),
    ]


def _arrow(x1: int, y1: int, x2: int, y2: int) -> str:
    return (
        f'<path d="M{x1} {y1}L{x2} {y2}" stroke="{_LINE}" stroke-width="2.5" '
        'marker-end="url(#tip)"/>'
    )


if __name__ == "__main__":
    for name in FLOWS:
        (FOLDER / f"{name}.svg").write_text(picture(name))
