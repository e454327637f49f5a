"""The cameras of a simulated robot, drawn into the terminal, so that a human sees what he moves, also over SSH."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping

import numpy as np

_PERIOD_S = 0.2
_LARGEST = 64  # px of the side of a picture; a terminal over SSH is slow
_TEXT_LINES = 6  # of the terminal, which the pictures leave


class TerminalView:
    """A view of cameras side by side, redrawn in place five times a second at most.

    Args:
        write: Writes text to the terminal, and flushes it.
    """

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write
        self._lines = 0  # of the pictures above the cursor
        self._next_s = 0.0  # of `time.monotonic`

    def draw(self, cameras: Mapping[str, np.ndarray]) -> None:
        """Draw the cameras' images, (H, W, 3) uint8 RGB, over those drawn last, if it is time."""
        now = time.monotonic()
        if not cameras or now < self._next_s:
            return
        self._next_s = now + _PERIOD_S
        terminal = shutil.get_terminal_size()
        side = min(_LARGEST, terminal.columns // len(cameras) - 1, 2 * (terminal.lines - _TEXT_LINES))
        lines = blocks([image for _, image in sorted(cameras.items())], max(2, side - side % 2))
        up = f"\x1b[{self._lines}A" if self._lines else ""
        self._write(up + "".join(f"\r{line}\x1b[0m\x1b[K\n" for line in lines))
        self._lines = len(lines)

    def leave(self) -> None:
        """Leave the pictures as they are, and draw the next ones below what is written in between."""
        self._lines = 0


def blocks(images: list[np.ndarray], side: int) -> list[str]:
    """Draw images side by side, two pixels a character.

    Args:
        images: The images, (H, W, 3) uint8 RGB each.
        side: The larger side of each, in pixels; even.

    Returns:
        The lines, with escape sequences of 24-bit colours.
    """
    rows = [np.zeros((side, 0, 3), np.uint8)]
    for image in images:
        height, width = (max(2, round(side * n / max(image.shape[:2]))) for n in image.shape[:2])
        y, x = np.arange(height) * image.shape[0] // height, np.arange(width) * image.shape[1] // width
        padded = np.zeros((side, width + 1, 3), np.uint8)
        padded[:height, :width] = image[y][:, x]
        rows.append(padded)
    pixels = np.concatenate(rows, axis=1)
    return ["".join(map(_cell, *pair)) for pair in zip(pixels[::2].tolist(), pixels[1::2].tolist(), strict=True)]


def _cell(above: list[int], below: list[int]) -> str:
    return "\x1b[38;2;{};{};{};48;2;{};{};{}m▀".format(*above, *below)
