"""Small antialiased pictures, painted once and then blended into an image with integer arithmetic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FloatArray = np.ndarray  # (h, w) float32 throughout, in pixels or as a coverage in [0, 1]
Colour = tuple[float, float, float]  # RGB, 0 to 255


@dataclass(frozen=True, slots=True)
class Sprite:
    """A picture with transparency; pixel (`left`, `top`) of it lies at the anchor's (0, 0) plus these."""

    paint: np.ndarray  # (h, w, 3) uint16, colour times opacity, opacity in [0, 256]
    keep: np.ndarray  # (h, w, 1) uint16, 256 minus the opacity
    left: int  # px
    top: int  # px

    def blend(self, image: np.ndarray, u: int, v: int) -> None:
        """Draw into `image`, (H, W, 3) uint8, with the anchor at column `u`, row `v`; cut at the edges."""
        x, y = u + self.left, v + self.top
        height, width = self.keep.shape[:2]
        x0, y0 = max(x, 0), max(y, 0)
        x1, y1 = min(x + width, image.shape[1]), min(y + height, image.shape[0])
        if x0 >= x1 or y0 >= y1:
            return
        inside = (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
        region = image[y0:y1, x0:x1]
        mixed = region * self.keep[inside]  # at most 255 * 256, which uint16 holds, as it does the sum
        mixed += self.paint[inside]
        mixed >>= 8
        region[...] = mixed


class Canvas:
    """Paints layers over each other; `u` and `v` are pixel centres relative to the anchor."""

    def __init__(self, left: float, right: float, up: float, down: float) -> None:
        """A canvas that reaches this many pixels from the anchor to each side."""
        self._left, self._top = -int(np.ceil(left)) - 1, -int(np.ceil(up)) - 1
        width = int(np.ceil(right)) + 2 - self._left
        height = int(np.ceil(down)) + 2 - self._top
        self.u: FloatArray = (np.arange(width, dtype=np.float32) + (self._left + 0.5))[None, :].repeat(height, 0)
        self.v: FloatArray = (np.arange(height, dtype=np.float32) + (self._top + 0.5))[:, None].repeat(width, 1)
        self._rgb = np.zeros((height, width, 3), np.float32)  # premultiplied
        self._alpha = np.zeros((height, width, 1), np.float32)

    def paint(self, colour: Colour | np.ndarray, coverage: FloatArray) -> None:
        """Paint a colour, one or (h, w, 3), over the canvas, with `coverage` in [0, 1]."""
        amount = np.clip(coverage, 0.0, 1.0)[..., None]
        self._rgb = self._rgb * (1 - amount) + np.asarray(colour, np.float32) * amount
        self._alpha = self._alpha * (1 - amount) + amount

    def sprite(self) -> Sprite:
        alpha = np.rint(self._alpha * 256)
        paint = np.minimum(np.rint(np.clip(self._rgb, 0, 255) * 256), alpha * 255)
        return Sprite(paint.astype(np.uint16), (256 - alpha).astype(np.uint16), self._left, self._top)

    def ellipse(self, u: float, v: float, radius_u: float, radius_v: float) -> FloatArray:
        """Coverage of an ellipse around (u, v)."""
        distance = np.hypot((self.u - u) / radius_u, (self.v - v) / radius_v) - 1
        return np.clip(0.5 - distance * min(radius_u, radius_v), 0, 1)

    def box(self, u: float, v: float, half_u: float, half_v: float, corner: float = 0.0) -> FloatArray:
        """Coverage of a box around (u, v) whose corners are rounded with radius `corner`."""
        across = np.abs(self.u - u) - (half_u - corner)
        down = np.abs(self.v - v) - (half_v - corner)
        outside = np.hypot(np.maximum(across, 0), np.maximum(down, 0))
        return np.clip(0.5 - (outside + np.minimum(np.maximum(across, down), 0) - corner), 0, 1)

    def glow(self, u: float, v: float, radius_u: float, radius_v: float) -> FloatArray:
        """A soft blob around (u, v): 1 in the middle, 0 from the radii on."""
        distance = np.clip(np.hypot((self.u - u) / radius_u, (self.v - v) / radius_v), 0, 1)
        fade: FloatArray = 1 - distance * distance * (3 - 2 * distance)
        return fade
