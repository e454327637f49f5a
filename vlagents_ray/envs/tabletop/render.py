"""Renderers of the table for the cameras "front" and "wrist".

Objects at rest are drawn once; a step copies that image and adds the gripper, the held object, and
their shadows. The camera's geometry is in the package's docstring.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vlagents_ray.envs.tabletop.world import (
    FINGER_RADIUS,
    PAD_HALF,
    PUCK_HEIGHT,
    PUCK_RADIUS,
    REACH,
    Pad,
    Puck,
    TabletopWorld,
)

VIEW = 0.66  # m, along the image's shorter side
ELEVATION = math.radians(70)

PALETTE: dict[str, Colour] = {
    "red": (220, 50, 47),
    "green": (40, 158, 66),
    "blue": (38, 110, 220),
    "yellow": (244, 196, 32),
    "purple": (128, 48, 190),
}
# Objects that no instruction names are nearly grey.
_FLOOR, _TABLE, _TABLE_EDGE = (58, 59, 62), (227, 225, 221), (168, 165, 160)
_FINGER, _PALM, _PALM_FRONT, _WRIST = (150, 152, 156), (86, 88, 92), (62, 63, 66), (118, 120, 124)
_TABLE_HALF = (0.315, 0.255)  # m
_TABLE_THICKNESS = 0.04  # m
_FINGER_LENGTH = 0.07  # m
_ENLARGED = 3  # times, by the camera "wrist"
_SHADOW = (0.35, -0.22)  # m, shadow offset along x and y per m of height


class TabletopRenderer:
    """A renderer for images of one size, which keeps the image of the objects at rest in the
    current episode.
    """

    def __init__(self, width: int, height: int) -> None:
        self._centre = (width / 2, height / 2)
        self._scale = min(width, height) / VIEW  # px/m
        self._up, self._deep = math.sin(ELEVATION), math.cos(ELEVATION)  # px/px of y and of z
        self._background = self._draw_background(width, height)
        self._pads = {name: self._draw_pad(colour) for name, colour in PALETTE.items()}
        self._pucks = {name: self._draw_puck(colour) for name, colour in PALETTE.items()}
        self._puck_shadow = self._draw_shadow(PUCK_RADIUS * 1.25, PUCK_RADIUS * 1.25, 0.42)
        self._gripper_shadow = self._draw_shadow(0.06, 0.03, 0.3)
        self._grippers: dict[int, Sprite] = {}  # by the gap in pixels
        self._floor_picture = self._background
        self._still = self._background
        self._still_key: tuple[tuple[float, float, float], ...] = ()

    def begin(self, pads: list[Pad]) -> None:
        """Draw the pads of an episode, which never move."""
        self._floor_picture = self._background.copy()
        for pad in pads:
            self._blend(self._floor_picture, self._pads[pad.colour], pad.x, pad.y, 0.0)
        self._still_key = ()

    def draw(self, world: TabletopWorld) -> np.ndarray:
        """Return the image, (H, W, 3) uint8 RGB, as a new array."""
        resting = [puck for puck in world.pucks if puck is not world.held_puck]
        key = tuple((puck.x, puck.y, puck.z) for puck in resting)
        if key != self._still_key:
            self._still, self._still_key = self._floor_picture.copy(), key
            # Near pucks hide far ones, and upper pucks lower ones.
            for puck in sorted(resting, key=lambda puck: (puck.z, -puck.y)):
                self._draw_puck_at(self._still, puck)

        image = self._still.copy()
        self._shade(image, self._gripper_shadow, world.x, world.y, world.z + _FINGER_LENGTH)
        if world.held_puck is not None:
            self._draw_puck_at(image, world.held_puck)

        gap = round(world.gap * self._scale)  # px
        if gap not in self._grippers:
            self._grippers[gap] = self._draw_gripper(float(gap))
        self._blend(image, self._grippers[gap], world.x, world.y, world.z)
        return image

    def _draw_puck_at(self, image: np.ndarray, puck: Puck) -> None:
        self._shade(image, self._puck_shadow, puck.x, puck.y, puck.z + PUCK_HEIGHT / 3)
        self._blend(image, self._pucks[puck.colour], puck.x, puck.y, puck.z)

    def _pixel(self, x: float, y: float, z: float) -> tuple[int, int]:
        """Return the column and the row of a point of the base frame."""
        u = self._centre[0] + self._scale * x
        v = self._centre[1] - self._scale * (y * self._up + z * self._deep)
        return round(u), round(v)

    def _blend(self, image: np.ndarray, sprite: Sprite, x: float, y: float, z: float) -> None:
        sprite.blend(image, *self._pixel(x, y, z))

    def _shade(self, image: np.ndarray, shadow: Sprite, x: float, y: float, height: float) -> None:
        self._blend(image, shadow, x + _SHADOW[0] * height, y + _SHADOW[1] * height, 0.0)

    def _draw_background(self, width: int, height: int) -> np.ndarray:
        s = self._scale
        canvas = Canvas(0, width, 0, height)
        cu, cv = self._centre
        canvas.paint(_FLOOR, np.ones_like(canvas.u))

        # The table with its shadow and its front edge.
        half_u, half_v = _TABLE_HALF[0] * s, _TABLE_HALF[1] * s * self._up
        drop = _TABLE_THICKNESS * s * self._deep
        canvas.paint(
            (30, 30, 32),
            0.8 * canvas.glow(cu + 0.03 * s, cv + 0.05 * s, half_u * 1.3, half_v * 1.5),
        )
        canvas.paint(_TABLE_EDGE, canvas.box(cu, cv + drop, half_u, half_v, 0.02 * s))
        distance = np.hypot((canvas.u - cu) / half_u + 0.5, (canvas.v - cv) / half_v + 0.6)
        light = 1.03 - 0.09 * distance / 2
        grain = np.random.default_rng(0).normal(0, 0.006, light.shape)
        canvas.paint(
            np.asarray(_TABLE) * (light + grain)[..., None],
            canvas.box(cu, cv, half_u, half_v, 0.02 * s),
        )

        # A line around the reach of the fingertips.
        reach_u, reach_v = REACH[0][1] * s, REACH[1][1] * s * self._up
        outer = canvas.box(cu, cv, reach_u, reach_v, 0.015 * s)
        inner = canvas.box(cu, cv, reach_u - 1, reach_v - 1, 0.015 * s)
        canvas.paint((200, 198, 194), 0.7 * (outer - inner))

        picture = np.zeros((height, width, 3), np.uint8)
        canvas.sprite().blend(picture, 0, 0)
        return picture

    def _draw_pad(self, colour: Colour) -> Sprite:
        half = PAD_HALF * self._scale
        tall = half * self._up
        canvas = Canvas(half, half, tall, tall)
        pastel = 0.45 * np.asarray(colour) + 0.55 * 245
        canvas.paint(pastel * 0.93, canvas.box(0, 0, half, tall, half * 0.2))
        rim = max(half * 0.1, 1.0)
        canvas.paint((250, 250, 250), canvas.box(0, 0, half - rim, tall - rim, half * 0.15))
        canvas.paint(pastel, canvas.box(0, 0, half - 1.7 * rim, tall - 1.7 * rim, half * 0.12))
        return canvas.sprite()

    def _draw_puck(self, colour: Colour) -> Sprite:
        r = PUCK_RADIUS * self._scale
        ry, h = r * self._up, PUCK_HEIGHT * self._scale * self._deep
        canvas = Canvas(r, r, h + ry, ry)
        base = np.asarray(colour, np.float32)
        cylinder = np.maximum.reduce(
            [
                canvas.ellipse(0, 0, r, ry),
                canvas.ellipse(0, -h, r, ry),
                canvas.box(0, -h / 2, r, h / 2),
            ]
        )
        light = 0.72 - 0.28 * canvas.u / r  # from the left
        canvas.paint(base * np.clip(light, 0.4, 1.0)[..., None], cylinder)
        canvas.paint(np.minimum(base * 1.08, 255), canvas.ellipse(0, -h, r, ry))
        canvas.paint(base * 0.94, canvas.ellipse(0, -h, r * 0.78, ry * 0.78))
        canvas.paint(
            (255, 255, 255), 0.4 * canvas.glow(-0.3 * r, -h - 0.3 * ry, 0.5 * r, 0.45 * ry)
        )
        return canvas.sprite()

    def _draw_shadow(self, half_x: float, half_y: float, darkness: float) -> Sprite:
        u, v = half_x * self._scale, half_y * self._scale * self._up
        canvas = Canvas(u, u, v, v)
        canvas.paint((20, 20, 24), darkness * canvas.glow(0, 0, u, v))
        return canvas.sprite()

    def _draw_gripper(self, gap: float) -> Sprite:
        """Draw two fingers `gap` pixels off the middle, the palm above them and the wrist on
        top.
        """
        s = self._scale
        finger, length = FINGER_RADIUS * s, _FINGER_LENGTH * s * self._deep
        half, tall = 0.052 * s, 0.016 * s  # of the palm
        front, above = 0.022 * s * self._deep, -length - 0.022 * s * self._deep
        canvas = Canvas(half + finger, half + finger, length + front + 2 * tall + 0.03 * s, finger)

        for sign in (-1.0, 1.0):
            u = sign * (gap + finger)
            canvas.paint(
                np.asarray(_FINGER) * 0.72,
                canvas.box(u, -length / 2, finger, length / 2 + finger / 2, finger / 2),
            )
            canvas.paint(
                _FINGER,
                canvas.box(u - finger * 0.25, -length / 2, finger * 0.6, length / 2, finger / 2),
            )

        canvas.paint(
            _PALM_FRONT,
            canvas.box(0, above + front / 2, half, tall * self._up + front / 2, 0.008 * s),
        )
        canvas.paint(_PALM, canvas.box(0, above, half, tall * self._up, 0.008 * s))
        canvas.paint((48, 49, 51), 0.6 * canvas.glow(0, above, 0.03 * s, 0.024 * s))

        wrist = 0.02 * s
        rise = 0.02 * s * self._deep
        column = np.maximum(
            canvas.ellipse(0, above, wrist, wrist * self._up),
            canvas.box(0, above - rise / 2, wrist, rise / 2),
        )
        canvas.paint(np.asarray(_WRIST) * 0.75, column)
        canvas.paint(_WRIST, canvas.ellipse(0, above - rise, wrist, wrist * self._up))
        canvas.paint(
            (176, 178, 182), canvas.ellipse(0, above - rise, wrist * 0.55, wrist * 0.55 * self._up)
        )
        return canvas.sprite()


class WristRenderer(TabletopRenderer):
    """A renderer of what is around the gripper: a third of what `TabletopRenderer` shows,
    enlarged.
    """

    def __init__(self, width: int, height: int) -> None:
        super().__init__(_ENLARGED * width, _ENLARGED * height)
        self._rows, self._columns = np.arange(height) - height // 2, np.arange(width) - width // 2

    def draw(self, world: TabletopWorld) -> np.ndarray:
        """Return the image around the fingertips, (H, W, 3) uint8 RGB, as a new array."""
        image = super().draw(world)
        u, v = self._pixel(world.x, world.y, world.z)
        rows = (self._rows + v).clip(0, len(image) - 1)
        columns = (self._columns + u).clip(0, image.shape[1] - 1)
        section: np.ndarray = image[rows[:, None], columns]
        return section


FloatArray = np.ndarray  # (h, w) float32 throughout, in pixels or as a coverage in [0, 1]
Colour = tuple[float, float, float]  # RGB, 0 to 255


@dataclass(frozen=True, slots=True)
class Sprite:
    """A picture with transparency; its pixel (`left`, `top`) is at the anchor's (0, 0) plus
    these offsets.
    """

    paint: np.ndarray  # (h, w, 3) uint16, colour times opacity, opacity in [0, 256]
    keep: np.ndarray  # (h, w, 1) uint16, 256 minus the opacity
    left: int  # px
    top: int  # px

    def blend(self, image: np.ndarray, u: int, v: int) -> None:
        """Draw into `image`, (H, W, 3) uint8, with the anchor at column `u`, row `v`; clip at
        the edges.
        """
        x, y = u + self.left, v + self.top
        height, width = self.keep.shape[:2]
        x0, y0 = max(x, 0), max(y, 0)
        x1, y1 = min(x + width, image.shape[1]), min(y + height, image.shape[0])
        if x0 >= x1 or y0 >= y1:
            return
        inside = (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
        region = image[y0:y1, x0:x1]
        # At most 255 * 256, and so is the sum: both fit in uint16.
        mixed = region * self.keep[inside]
        mixed += self.paint[inside]
        mixed >>= 8
        region[...] = mixed


class Canvas:
    """Paints layers over each other; `u` and `v` are pixel centres relative to the anchor."""

    def __init__(self, left: float, right: float, up: float, down: float) -> None:
        """Make a canvas that extends by this many pixels from the anchor to each side."""
        self._left, self._top = -int(np.ceil(left)) - 1, -int(np.ceil(up)) - 1
        width = int(np.ceil(right)) + 2 - self._left
        height = int(np.ceil(down)) + 2 - self._top
        columns = np.arange(width, dtype=np.float32) + (self._left + 0.5)
        rows = np.arange(height, dtype=np.float32) + (self._top + 0.5)
        self.u: FloatArray = columns[None, :].repeat(height, 0)
        self.v: FloatArray = rows[:, None].repeat(width, 1)
        self._rgb = np.zeros((height, width, 3), np.float32)  # premultiplied
        self._alpha = np.zeros((height, width, 1), np.float32)

    def paint(self, colour: Colour | np.ndarray, coverage: FloatArray) -> None:
        """Paint a colour, one for all pixels or (h, w, 3), over the canvas, with `coverage` in
        [0, 1].
        """
        amount = np.clip(coverage, 0.0, 1.0)[..., None]
        self._rgb = self._rgb * (1 - amount) + np.asarray(colour, np.float32) * amount
        self._alpha = self._alpha * (1 - amount) + amount

    def sprite(self) -> Sprite:
        """Return the painted picture."""
        alpha = np.rint(self._alpha * 256)
        paint = np.minimum(np.rint(np.clip(self._rgb, 0, 255) * 256), alpha * 255)
        return Sprite(
            paint.astype(np.uint16), (256 - alpha).astype(np.uint16), self._left, self._top
        )

    def ellipse(self, u: float, v: float, radius_u: float, radius_v: float) -> FloatArray:
        """Return the coverage of an ellipse around (u, v)."""
        distance = np.hypot((self.u - u) / radius_u, (self.v - v) / radius_v) - 1
        return np.clip(0.5 - distance * min(radius_u, radius_v), 0, 1)

    def box(
        self, u: float, v: float, half_u: float, half_v: float, corner: float = 0.0
    ) -> FloatArray:
        """Return the coverage of a rectangle around (u, v) with rounded corners."""
        across = np.abs(self.u - u) - (half_u - corner)
        down = np.abs(self.v - v) - (half_v - corner)
        outside = np.hypot(np.maximum(across, 0), np.maximum(down, 0))
        return np.clip(0.5 - (outside + np.minimum(np.maximum(across, down), 0) - corner), 0, 1)

    def glow(self, u: float, v: float, radius_u: float, radius_v: float) -> FloatArray:
        """Return a soft blob around (u, v): 1 in the middle, 0 beyond the radii."""
        distance = np.clip(np.hypot((self.u - u) / radius_u, (self.v - v) / radius_v), 0, 1)
        fade: FloatArray = 1 - distance * distance * (3 - 2 * distance)
        return fade
