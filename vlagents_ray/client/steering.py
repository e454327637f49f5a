"""The messages by which a human at the live page moves a robot: JSON over two WebSockets that meet at the server.

    robot to server     {"session": "7f3a", "beat": 42, "hold": "c41d", "moves": true, "why": "", "ended": ["", ""]}
    server to robot     {"do": "begin", "hold": "c41d", "by": "lab"}
                        {"do": "move", "hold": "c41d", "seq": 7, "beat": 41, "axes": [0, 1, 0, 0, 0, 0], "grips": 2}
                        {"do": "release", "hold": "c41d"}, {"do": "gone", "hold": "c41d", "why": "…"}
                        {} as the answer to each beat

A hold lasts from the moment at which a human takes over until he gives back. The robot numbers its beats, and each
command repeats the number of the last beat that the human's page has seen: so the robot knows by its own clock how old
a command is at most, whatever the clocks and the buffers between the two do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeGuard

from vlagents_ray.errors import MalformedMessage

ROBOT_PATH = "/v1/live/robot"
BEAT_S = 0.05  # interval of a robot's beats while a human holds it
IDLE_S = 0.5  # interval at other times
SILENT_S = 3.0  # a human, or a robot, of whom nothing was heard for this long is gone
AXES = 6
_MOST = 2**53  # largest count that JSON keeps


@dataclass(frozen=True, slots=True)
class Steering:
    """A motion that a human asks for."""

    seq: int  # increases from command to command of a hold
    beat: int  # the last beat of the robot that was seen when it was sent
    axes: tuple[float, ...]  # x, y, z, roll, pitch, yaw, each in [-1, 1]
    grips: int  # how often the gripper's button was pressed in this hold

    @classmethod
    def of(cls, stated: object) -> Steering:
        """Read the entries of a message.

        Args:
            stated: The message; further entries are left out.

        Raises:
            MalformedMessage: An entry is missing, or has another form.
        """
        found = stated if isinstance(stated, Mapping) else {}
        seq, beat, grips, axes = (found.get(name) for name in ("seq", "beat", "grips", "axes"))
        if not (_is_count(seq) and _is_count(beat) and _is_count(grips)):
            raise MalformedMessage(f"steering: got seq, beat, grips of {[seq, beat, grips]!r:.80}, want counts from 0")
        if not isinstance(axes, list) or len(axes) != AXES or not all(map(_is_axis, axes)):
            raise MalformedMessage(f"steering: got axes {axes!r:.80}, want {AXES} numbers from -1 to 1")
        return cls(seq, beat, tuple(map(float, axes)), grips)

    def message(self, hold: str) -> dict[str, Any]:
        """Return the message to the robot that is held."""
        return {"do": "move", "hold": hold, **asdict(self), "axes": list(self.axes)}


def _is_count(value: object) -> TypeGuard[int]:
    return type(value) is int and 0 <= value < _MOST


def _is_axis(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and -1 <= value <= 1  # type: ignore[arg-type,operator]
