"""A control for the reference policy, which receives the instruction of another task."""

from __future__ import annotations

from vlagents_ray.policies.reference import Reference

_COLOURS = {"red": "yellow", "yellow": "green", "green": "blue", "blue": "purple", "purple": "red"}
_DEEDS = {
    "button press topdown": "drawer close",
    "drawer close": "drawer open",
    "drawer open": "window close",
    "window close": "button press topdown",
}


class Misled(Reference):
    """The reference policy with a wrong instruction: each colour is replaced with another
    colour, or the task with another task.
    """

    def _begin(self, instruction: str, seed: int) -> None:
        other = _DEEDS.get(instruction) or " ".join(
            _COLOURS.get(word, word) for word in instruction.split()
        )
        super()._begin(other, seed)
