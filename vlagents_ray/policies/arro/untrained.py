"""Parts without weights, for simulations and tests: a detector of colours, a segmenter of flat regions, a tracker."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from PIL import Image
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.parts import Detection, Images, box_of, flat, largest, overlap, split

_HUES = {"red": 0.0, "orange": 28.0, "yellow": 48.0, "green": 132.0, "cyan": 180.0, "blue": 216.0, "purple": 275.0}


class ColourConfig(BaseModel, extra="forbid"):
    """The hue of each word, and which pixels count as coloured."""

    hues: dict[str, float] = Field(default=_HUES, description="word -> hue in degrees")
    tolerance: float = Field(default=20.0, gt=0, le=180, description="degrees on both sides")
    saturation: float = Field(default=0.15, ge=0, le=1, description="the least, in HSV")
    value: float = Field(default=0.2, ge=0, le=1, description="the least, in HSV")
    smallest: float = Field(default=5e-4, ge=0, le=1, description="of a region, as a share of the image")


class ColourDetector:
    """Detects each connected region of the colours in a phrase: all that is red for "lift the red puck"."""

    Config: ClassVar[type] = ColourConfig

    def __init__(self, config: ColourConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing: there are no weights."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return regions by their size; a phrase without a colour has none."""
        return [self._detections(image, asked) for image, asked in zip(images, phrases, strict=True)]

    def _detections(self, image: np.ndarray, phrases: Sequence[str]) -> list[Detection]:
        hue, saturation, value = np.moveaxis(np.asarray(Image.fromarray(image).convert("HSV"), np.float32), -1, 0)
        coloured = (saturation >= self._config.saturation * 255) & (value >= self._config.value * 255)
        smallest = max(1, round(self._config.smallest * hue.size))
        found = []
        for phrase in phrases:
            for word in sorted(set(re.findall(r"\w+", phrase.lower())) & set(self._config.hues)):
                off = np.abs((hue * (360 / 256) - self._config.hues[word] + 180) % 360 - 180)
                for mask in split(coloured & (off <= self._config.tolerance), smallest):
                    found.append(Detection(phrase, box_of(mask), np.count_nonzero(mask) / mask.size, mask))
        return sorted(found, key=lambda one: -one.score)


class FlatConfig(BaseModel, extra="forbid"):
    """The criteria of a region."""

    tolerance: int = Field(default=8, ge=0, le=255, description="of neighbouring pixels, in every channel")
    smallest: float = Field(default=2e-4, ge=0, le=1, description="of a proposed region, as a share of the image")
    most: int = Field(default=256, ge=1, description="regions that are proposed, the largest first")


class FlatSegmenter:
    """Finds regions within which the colour changes little from pixel to pixel."""

    Config: ClassVar[type] = FlatConfig

    def __init__(self, config: FlatConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing: there are no weights."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the content of each box, without the regions that extend beyond it."""
        return [self._inside(image, around) for image, around in zip(images, boxes, strict=True)]

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return all regions that are not too small."""
        return [self._regions(image) for image in images]

    def _inside(self, image: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        labels = flat(image, self._config.tolerance)
        masks = np.zeros((len(boxes), *labels.shape), bool)
        for i, (left, top, right, bottom) in enumerate(np.rint(boxes).astype(int).clip(0)):
            masks[i, top:bottom, left:right] = True
            masks[i] &= ~np.isin(labels, labels[~masks[i]])
        return masks

    def _regions(self, image: np.ndarray) -> np.ndarray:
        labels = flat(image, self._config.tolerance)
        chosen = largest(labels, max(1, round(self._config.smallest * labels.size)))[: self._config.most]
        return np.asarray(labels == chosen[:, None, None])


class CircleConfig(BaseModel, extra="forbid"):
    """The position of the gripper at the beginning of an episode."""

    point: tuple[float, float] = Field(
        default=(0.5, 0.0), description="the circle's centre: x in widths of the image, y in its heights, from top left"
    )
    radius: float = Field(default=0.25, gt=0, description="in shorter sides of the image")


class CircleSelector:
    """Selects regions that lie wholly in a circle: for a fixed camera, and a robot that begins at home."""

    Config: ClassVar[type] = CircleConfig

    def __init__(self, config: CircleConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing: there are no weights."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Return those regions, whatever they show."""
        chosen = []
        for image, masks in zip(images, regions, strict=True):
            height, width = image.shape[:2]
            x, y = self._config.point[0] * width, self._config.point[1] * height
            v, u = np.mgrid[:height, :width] + 0.5
            outside = np.hypot(u - x, v - y) > self._config.radius * min(height, width)
            chosen.append([i for i, mask in enumerate(masks) if mask.any() and not (mask & outside).any()])
        return chosen


_SHADES = 16  # levels of each channel


class IouConfig(BaseModel, extra="forbid"):
    """The distance that a segment may move, and the share of it that must remain visible."""

    reach: float = Field(default=0.1, ge=0, le=1, description="to each side a frame, in shorter sides of the image")
    least: float = Field(default=0.2, gt=0, le=1, description="a region with a smaller share of its first pixels: lost")
    most: float = Field(default=3.0, ge=1, description="a region with a larger multiple of them: something else")


@dataclass(slots=True)
class _Segment:
    colours: np.ndarray  # (4096,) bool: colours with a greater share in the segment than in the rest of the first frame
    pixels: int  # on the first frame
    mask: np.ndarray  # (H, W) bool, its last visible position


class IouTracker:
    """Tracks the connected region in a segment's colours that best overlaps the segment's last position."""

    Config: ClassVar[type] = IouConfig

    def __init__(self, config: IouConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing: there are no weights."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Return the colours of each segment."""
        return [
            [_Segment(_own_colours(shades, mask), int(np.count_nonzero(mask)), mask.copy()) for mask in own]
            for shades, own in zip(map(_shades, images), masks, strict=True)
        ]

    def follow(self, images: Images, memories: Sequence[Any]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Search each segment around its last position."""
        followed = []
        for image, segments in zip(images, memories, strict=True):
            shades = _shades(image)
            seen = np.array([self._moved(shades, segment) for segment in segments])
            followed.append((np.stack([segment.mask for segment in segments]), seen))
        return followed

    def _moved(self, shades: np.ndarray, segment: _Segment) -> bool:
        """Move the segment to its current position; return False if it is not visible."""
        reach = round(self._config.reach * min(shades.shape))
        left, top, right, bottom = box_of(segment.mask).astype(int)
        window = slice(max(top - reach, 0), bottom + reach), slice(max(left - reach, 0), right + reach)
        last = segment.mask[window]
        alike = split(segment.colours[shades[window]], max(1, round(self._config.least * segment.pixels)))
        regions = [region for region in alike if np.count_nonzero(region) <= self._config.most * segment.pixels]
        if not regions:
            return False
        mask = np.zeros_like(segment.mask)
        # the nearest region where none overlaps: a small object moves by more than its own size
        mask[window] = max(regions, key=lambda region: (overlap(region, last), -_distance(region, last)))
        segment.mask = mask
        return True


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.hypot(*(np.argwhere(one).mean(0) - np.argwhere(other).mean(0))))


def _shades(image: np.ndarray) -> np.ndarray:
    """Return (H, W) int: the index of each pixel's colour among 4096."""
    red, green, blue = np.moveaxis(image.astype(np.int32) * _SHADES // 256, -1, 0)
    return np.asarray((red * _SHADES + green) * _SHADES + blue)


def _own_colours(shades: np.ndarray, mask: np.ndarray) -> np.ndarray:
    inside, outside = (np.bincount(shades[where], minlength=_SHADES**3) for where in (mask, ~mask))
    return np.asarray(inside * outside.sum() > outside * inside.sum())
