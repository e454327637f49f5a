"""The student's perception: the positions of each colour on the table, and the colour in the
instruction.
"""

from __future__ import annotations

import math
import re

import numpy as np

from vlagents_ray.envs.tabletop.render import ELEVATION, VIEW
from vlagents_ray.envs.tabletop.world import PUCK_HEIGHT
from vlagents_ray.errors import InvalidObservation

# The hue of each colour on the colour wheel, degrees.
_ANGLES = {"red": 1.0, "yellow": 46.0, "green": 133.0, "blue": 216.0, "purple": 274.0}
WORDS = tuple(_ANGLES)
_HUES = 12  # number of bins of the colour wheel
BINS = 2 * _HUES  # number of bins: first the pale colours, then the saturated colours
_COLOURED = 0.12  # smallest difference of the largest and the smallest channel, in [0, 1]
_FULL = 0.5  # smallest saturation of saturated colours
_PIXELS = 20.0  # unit of the first column, pixels


def places(image: np.ndarray) -> np.ndarray:
    """Locate the pixels of each colour.

    Args:
        image: The camera's image, (H, W, 3) uint8.

    Returns:
        For each bin, the number of its pixels in units of 20, and their mean x and y on the table
        in dm from the point at which the camera is aimed, (24, 3) float32. Bins without pixels are
        0.
    """
    height, width = image.shape[:2]
    pixels = image.reshape(-1, 3).astype(np.float32) / 255.0
    brightest, darkest = pixels.max(1), pixels.min(1)
    seen = np.flatnonzero(brightest - darkest > _COLOURED)
    red, green, blue = pixels[seen].T
    brightest, chroma = brightest[seen], (brightest - darkest)[seen]
    # https://en.wikipedia.org/wiki/HSL_and_HSV#Hue_and_chroma
    sextant = np.select(
        [brightest == red, brightest == green],
        [(green - blue) / chroma % 6, (blue - red) / chroma + 2],
        (red - green) / chroma + 4,
    )
    bins = np.rint(sextant / 6 * _HUES).astype(np.int64) % _HUES + _HUES * (
        chroma > _FULL * brightest
    )
    number = np.bincount(bins, minlength=BINS)
    rows, columns = np.divmod(seen, width)
    scale = min(width, height) / (10 * VIEW)  # pixels per dm
    x = (columns + 0.5 - width / 2) / scale
    y = (height / 2 - rows - 0.5) / scale / math.sin(ELEVATION)
    middle = [
        np.bincount(bins, weights=one, minlength=BINS) / np.maximum(number, 1) for one in (x, y)
    ]
    return np.stack([number / _PIXELS, *middle], axis=1).astype(np.float32)


def puck_position(image: np.ndarray, colour: str) -> tuple[float, float] | None:
    """Return the position of a puck, (x, y) m, from the mean of its pixels; None if fewer than
    three pixels are visible.
    """
    middle = round(_ANGLES[colour] / 360 * _HUES)
    number, x, y = places(image)[[_HUES + (middle + step) % _HUES for step in (-1, 0, 1)]].T
    if number.sum() * _PIXELS < 3:
        return None
    # Apparent additional distance of the puck's middle, m.
    above = PUCK_HEIGHT / 2 / math.tan(ELEVATION)
    return float(number @ x / number.sum()) / 10, float(number @ y / number.sum()) / 10 - above


def named_colour(instruction: str | None) -> str:
    """Return the colour of the puck that an instruction names.

    Raises:
        InvalidObservation: The instruction names no colour.
    """
    found = re.search(r"the (\w+) puck", instruction or "")
    if found is None or found[1] not in WORDS:
        raise InvalidObservation(
            f"instruction: expected 'lift the COLOUR puck' with one of {WORDS}, got {instruction!r}"
        )
    return found[1]
