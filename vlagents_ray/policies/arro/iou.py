"""A tracker by colour and overlap, for simulations and tests: no weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.parts import Images
from vlagents_ray.policies.arro.regions import box_of, overlap, split

_SHADES = 16  # that each channel is divided into


class IouConfig(BaseModel, extra="forbid"):
    """How far a segment may move, and how much of it must be left to be seen."""

    reach: float = Field(default=0.1, ge=0, le=1, description="to each side a frame, in shorter sides of the image")
    least: float = Field(default=0.2, gt=0, le=1, description="a region with a smaller share of its first pixels: lost")
    most: float = Field(default=3.0, ge=1, description="a region with a larger multiple of them: something else")


@dataclass(slots=True)
class _Segment:
    colours: np.ndarray  # (4096,) bool: those with a greater share in it than in the rest of the first frame
    pixels: int  # on the first frame
    mask: np.ndarray  # (H, W) bool, where it was seen last


class IouTracker:
    """Of the connected regions in a segment's own colours, the one whose overlap with its last place is the best."""

    Config: ClassVar[type] = IouConfig

    def __init__(self, config: IouConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Nothing to load."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """The colours of each segment."""
        return [
            [_Segment(_own_colours(shades, mask), int(np.count_nonzero(mask)), mask.copy()) for mask in own]
            for shades, own in zip(map(_shades, images), masks, strict=True)
        ]

    def follow(self, images: Images, memories: Sequence[Any]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Each segment looked for around its last place."""
        followed = []
        for image, segments in zip(images, memories, strict=True):
            shades = _shades(image)
            seen = np.array([self._moved(shades, segment) for segment in segments])
            followed.append((np.stack([segment.mask for segment in segments]), seen))
        return followed

    def _moved(self, shades: np.ndarray, segment: _Segment) -> bool:
        """Move the segment to where it is now; False if it is not to be seen."""
        reach = round(self._config.reach * min(shades.shape))
        left, top, right, bottom = box_of(segment.mask).astype(int)
        window = slice(max(top - reach, 0), bottom + reach), slice(max(left - reach, 0), right + reach)
        last = segment.mask[window]
        alike = split(segment.colours[shades[window]], max(1, round(self._config.least * segment.pixels)))
        regions = [region for region in alike if np.count_nonzero(region) <= self._config.most * segment.pixels]
        if not regions:
            return False
        mask = np.zeros_like(segment.mask)
        # the nearest one where none overlaps: a small thing moves by more than its own size
        mask[window] = max(regions, key=lambda region: (overlap(region, last), -_distance(region, last)))
        segment.mask = mask
        return True


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.hypot(*(np.argwhere(one).mean(0) - np.argwhere(other).mean(0))))


def _shades(image: np.ndarray) -> np.ndarray:
    """(H, W) int: the number of each pixel's colour among 4096."""
    red, green, blue = np.moveaxis(image.astype(np.int32) * _SHADES // 256, -1, 0)
    return np.asarray((red * _SHADES + green) * _SHADES + blue)


def _own_colours(shades: np.ndarray, mask: np.ndarray) -> np.ndarray:
    inside, outside = (np.bincount(shades[where], minlength=_SHADES**3) for where in (mask, ~mask))
    return np.asarray(inside * outside.sum() > outside * inside.sum())
