"""Renderers of the table for the cameras "front" and "wrist".

Objects at rest are drawn once. For each step, the renderer copies this image and adds the gripper,
the held object and their shadows. The geometry of the camera is in the docstring of the package.
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

VIEW = 0.66  # m, length of the table plane that the image's shorter side shows
ELEVATION = math.radians(70)

PALETTE: dict[str, Colour] = {
    "red": (220, 50, 47),
    "green": (40, 158, 66),
    "blue": (38, 110, 220),
    "yellow": (244, 196, 32),
    "purple": (128, 48, 190),
}
# Nearly grey colours, for all objects that do not occur in instructions.
_FLOOR, _TABLE, _TABLE_EDGE = (58, 59, 62), (227, 225, 221), (168, 165, 160)
_FINGER, _PALM, _PALM_FRONT, _WRIST = (150, 152, 156), (86, 88, 92), (62, 63, 66), (118, 120, 124)
_TABLE_HALF = (0.315, 0.255)  # m
_TABLE_THICKNESS = 0.04  # m
_FINGER_LENGTH = 0.07  # m
_ENLARGED = 3  # magnification of the camera "wrist"
_SHADOW = (0.35, -0.22)  # m/m, offset of a shadow along x and y for each metre of height


class TabletopRenderer:
    """A renderer of the camera "front", for images of one size.

    It stores the image of the objects at rest in the current episode.
    """

    def __init__(self, width: int, height: int) -> None:
        """Draw the sprites of all objects, for images of this size, px."""
        self._centre = (width / 2, height / 2)
        self._scale = min(width, height) / VIEW  # px/m
        # Factors that project lengths along y and z onto the image's vertical axis.
        self._y_factor, self._z_factor = math.sin(ELEVATION), math.cos(ELEVATION)

        self._background = self._draw_background(width, height)
        self._pads = {name: self._draw_pad(colour) for name, colour in PALETTE.items()}
        self._pucks = {name: self._draw_puck(colour) for name, colour in PALETTE.items()}
        self._puck_shadow = self._draw_shadow(PUCK_RADIUS * 1.25, PUCK_RADIUS * 1.25, 0.42)
        self._gripper_shadow = self._draw_shadow(0.06, 0.03, 0.3)
        self._grippers: dict[int, Sprite] = {}  # sprites of the gripper by gap, px

        # Image of the background and the pads of the episode.
        self._floor_picture = self._background
        # Image of the background, the pads and the pucks at rest, with the pucks' positions.
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
            # Near pucks hide far ones, and upper pucks hide lower ones.
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
        """Draw a puck and its shadow."""
        self._shade(image, self._puck_shadow, puck.x, puck.y, puck.z + PUCK_HEIGHT / 3)
        self._blend(image, self._pucks[puck.colour], puck.x, puck.y, puck.z)

    def _pixel(self, x: float, y: float, z: float) -> tuple[int, int]:
        """Return the column and the row of a point in the base frame."""
        column = self._centre[0] + self._scale * x
        row = self._centre[1] - self._scale * (y * self._y_factor + z * self._z_factor)
        return round(column), round(row)

    def _blend(self, image: np.ndarray, sprite: Sprite, x: float, y: float, z: float) -> None:
        """Draw a sprite at a point in the base frame."""
        sprite.blend(image, *self._pixel(x, y, z))

    def _shade(self, image: np.ndarray, shadow: Sprite, x: float, y: float, height: float) -> None:
        """Draw the shadow of an object at (x, y, height) m on the table."""
        self._blend(image, shadow, x + _SHADOW[0] * height, y + _SHADOW[1] * height, 0.0)

    def _draw_background(self, width: int, height: int) -> np.ndarray:
        """Draw the floor and the empty table."""
        scale = self._scale
        canvas = Canvas(0, width, 0, height)
        centre_u, centre_v = self._centre
        canvas.paint(_FLOOR, np.ones_like(canvas.u))

        # The shadow of the table, and its front edge.
        half_u, half_v = _TABLE_HALF[0] * scale, _TABLE_HALF[1] * scale * self._y_factor
        corner = 0.02 * scale
        shadow = canvas.glow(
            centre_u + 0.03 * scale, centre_v + 0.05 * scale, half_u * 1.3, half_v * 1.5
        )
        canvas.paint((30, 30, 32), 0.8 * shadow)
        drop = _TABLE_THICKNESS * scale * self._z_factor
        canvas.paint(_TABLE_EDGE, canvas.box(centre_u, centre_v + drop, half_u, half_v, corner))

        # The table is brighter near the light, and has a grain.
        distance = np.hypot(
            (canvas.u - centre_u) / half_u + 0.5, (canvas.v - centre_v) / half_v + 0.6
        )
        light = 1.03 - 0.09 * distance / 2
        grain = np.random.default_rng(0).normal(0, 0.006, light.shape)
        table_colours = np.asarray(_TABLE) * (light + grain)[..., None]
        canvas.paint(table_colours, canvas.box(centre_u, centre_v, half_u, half_v, corner))

        # A line marks the reach of the fingertips.
        reach_u, reach_v = REACH[0][1] * scale, REACH[1][1] * scale * self._y_factor
        outer = canvas.box(centre_u, centre_v, reach_u, reach_v, 0.015 * scale)
        inner = canvas.box(centre_u, centre_v, reach_u - 1, reach_v - 1, 0.015 * scale)
        canvas.paint((200, 198, 194), 0.7 * (outer - inner))

        picture = np.zeros((height, width, 3), np.uint8)
        canvas.sprite().blend(picture, 0, 0)
        return picture

    def _draw_pad(self, colour: Colour) -> Sprite:
        """Draw a square with a white rim."""
        half_u = PAD_HALF * self._scale
        half_v = half_u * self._y_factor
        canvas = Canvas(half_u, half_u, half_v, half_v)
        pastel = 0.45 * np.asarray(colour) + 0.55 * 245
        rim = max(half_u * 0.1, 1.0)

        canvas.paint(pastel * 0.93, canvas.box(0, 0, half_u, half_v, half_u * 0.2))
        white = canvas.box(0, 0, half_u - rim, half_v - rim, half_u * 0.15)
        canvas.paint((250, 250, 250), white)
        inner = canvas.box(0, 0, half_u - 1.7 * rim, half_v - 1.7 * rim, half_u * 0.12)
        canvas.paint(pastel, inner)
        return canvas.sprite()

    def _draw_puck(self, colour: Colour) -> Sprite:
        """Draw a cylinder, whose anchor is the centre of its underside."""
        radius_u = PUCK_RADIUS * self._scale
        radius_v = radius_u * self._y_factor
        height = PUCK_HEIGHT * self._scale * self._z_factor
        canvas = Canvas(radius_u, radius_u, height + radius_v, radius_v)
        base = np.asarray(colour, np.float32)

        bottom = canvas.ellipse(0, 0, radius_u, radius_v)
        top = canvas.ellipse(0, -height, radius_u, radius_v)
        side = canvas.box(0, -height / 2, radius_u, height / 2)
        light = 0.72 - 0.28 * canvas.u / radius_u  # light from the left
        side_colours = base * np.clip(light, 0.4, 1.0)[..., None]
        canvas.paint(side_colours, np.maximum.reduce([bottom, top, side]))

        canvas.paint(np.minimum(base * 1.08, 255), top)
        canvas.paint(base * 0.94, canvas.ellipse(0, -height, radius_u * 0.78, radius_v * 0.78))
        highlight = canvas.glow(
            -0.3 * radius_u, -height - 0.3 * radius_v, 0.5 * radius_u, 0.45 * radius_v
        )
        canvas.paint((255, 255, 255), 0.4 * highlight)
        return canvas.sprite()

    def _draw_shadow(self, half_x: float, half_y: float, darkness: float) -> Sprite:
        """Draw an ellipse with these semi-axes, m, which fades towards its edge."""
        half_u, half_v = half_x * self._scale, half_y * self._scale * self._y_factor
        canvas = Canvas(half_u, half_u, half_v, half_v)
        canvas.paint((20, 20, 24), darkness * canvas.glow(0, 0, half_u, half_v))
        return canvas.sprite()

    def _draw_gripper(self, gap: float) -> Sprite:
        """Draw two fingers, the palm above them, and the wrist on top.

        Args:
            gap: Distance of each finger from the middle between them, px.
        """
        scale = self._scale
        finger, length = FINGER_RADIUS * scale, _FINGER_LENGTH * scale * self._z_factor
        palm_half, palm_depth = 0.052 * scale, 0.016 * scale
        palm_height = 0.022 * scale * self._z_factor
        palm_v = -length - 0.022 * scale * self._z_factor
        width = palm_half + finger
        up = length + palm_height + 2 * palm_depth + 0.03 * scale
        canvas = Canvas(width, width, up, finger)

        # Each finger is a dark bar with a lighter, narrower bar on its left.
        for sign in (-1.0, 1.0):
            finger_u = sign * (gap + finger)
            dark = canvas.box(finger_u, -length / 2, finger, length / 2 + finger / 2, finger / 2)
            canvas.paint(np.asarray(_FINGER) * 0.72, dark)
            bright = canvas.box(
                finger_u - finger * 0.25, -length / 2, finger * 0.6, length / 2, finger / 2
            )
            canvas.paint(_FINGER, bright)

        # The palm consists of its front, its upper side, and the shadow of the wrist on the upper
        # side.
        palm_half_v = palm_depth * self._y_factor
        corner = 0.008 * scale
        front = canvas.box(
            0, palm_v + palm_height / 2, palm_half, palm_half_v + palm_height / 2, corner
        )
        canvas.paint(_PALM_FRONT, front)
        canvas.paint(_PALM, canvas.box(0, palm_v, palm_half, palm_half_v, corner))
        canvas.paint((48, 49, 51), 0.6 * canvas.glow(0, palm_v, 0.03 * scale, 0.024 * scale))

        # The wrist is a cylinder with a lighter disc on its upper side.
        radius_u = 0.02 * scale
        radius_v = radius_u * self._y_factor
        rise = 0.02 * scale * self._z_factor
        bottom = canvas.ellipse(0, palm_v, radius_u, radius_v)
        side = canvas.box(0, palm_v - rise / 2, radius_u, rise / 2)
        canvas.paint(np.asarray(_WRIST) * 0.75, np.maximum(bottom, side))
        canvas.paint(_WRIST, canvas.ellipse(0, palm_v - rise, radius_u, radius_v))
        disc = canvas.ellipse(0, palm_v - rise, radius_u * 0.55, radius_u * 0.55 * self._y_factor)
        canvas.paint((176, 178, 182), disc)
        return canvas.sprite()


class WristRenderer(TabletopRenderer):
    """A renderer of the camera "wrist", which shows the surroundings of the gripper.

    The image is an enlarged third of the image of `TabletopRenderer`.
    """

    def __init__(self, width: int, height: int) -> None:
        super().__init__(_ENLARGED * width, _ENLARGED * height)
        self._rows, self._columns = np.arange(height) - height // 2, np.arange(width) - width // 2

    def draw(self, world: TabletopWorld) -> np.ndarray:
        """Return the image around the fingertips, (H, W, 3) uint8 RGB, as a new array."""
        image = super().draw(world)
        column, row = self._pixel(world.x, world.y, world.z)
        rows = (self._rows + row).clip(0, len(image) - 1)
        columns = (self._columns + column).clip(0, image.shape[1] - 1)
        section: np.ndarray = image[rows[:, None], columns]
        return section


FloatArray = np.ndarray  # (h, w) float32: coordinates in pixels, or a coverage in [0, 1]
Colour = tuple[float, float, float]  # RGB, 0 to 255


@dataclass(frozen=True, slots=True)
class Sprite:
    """A picture with transparency."""

    paint: np.ndarray  # (h, w, 3) uint16, colour times opacity, opacity in [0, 256]
    keep: np.ndarray  # (h, w, 1) uint16, 256 minus the opacity
    left: int  # px, column of the first pixel from the anchor
    top: int  # px, row of the first pixel from the anchor

    def blend(self, image: np.ndarray, u: int, v: int) -> None:
        """Draw the sprite into an image; parts outside the image are clipped.

        Args:
            image: (H, W, 3) uint8, which is changed.
            u: The column of the anchor.
            v: The row of the anchor.
        """
        x, y = u + self.left, v + self.top
        height, width = self.keep.shape[:2]
        x0, y0 = max(x, 0), max(y, 0)
        x1, y1 = min(x + width, image.shape[1]), min(y + height, image.shape[0])
        if x0 >= x1 or y0 >= y1:
            return

        inside = (slice(y0 - y, y1 - y), slice(x0 - x, x1 - x))
        region = image[y0:y1, x0:x1]
        # The product and the sum are at most 255 * 256, which fits in uint16.
        mixed = region * self.keep[inside]
        mixed += self.paint[inside]
        mixed >>= 8
        region[...] = mixed


class Canvas:
    """Paints layers on top of each other; `u` and `v` are pixel centres relative to the anchor."""

    def __init__(self, left: float, right: float, up: float, down: float) -> None:
        """Create a canvas that extends by these numbers of pixels from the anchor to each side."""
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
        """Paint a layer over the canvas.

        Args:
            colour: One colour for all pixels, or (h, w, 3).
            coverage: Opacity of the layer in each pixel, (h, w) in [0, 1].
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
