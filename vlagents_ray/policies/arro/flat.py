"""A segmenter of evenly coloured regions, and a selector by place: no weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.parts import Images
from vlagents_ray.policies.arro.regions import flat, largest


class FlatConfig(BaseModel, extra="forbid"):
    """What counts as one region."""

    tolerance: int = Field(default=8, ge=0, le=255, description="of neighbouring pixels, in every channel")
    smallest: float = Field(default=2e-4, ge=0, le=1, description="of a proposed region, as a share of the image")
    most: int = Field(default=256, ge=1, description="regions that are proposed, the largest first")


class FlatSegmenter:
    """Regions within which the colour changes little from pixel to pixel."""

    Config: ClassVar[type] = FlatConfig

    def __init__(self, config: FlatConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Nothing to load."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What lies in each box but for the regions that reach out of it."""
        return [self._inside(image, around) for image, around in zip(images, boxes, strict=True)]

    def propose(self, images: Images) -> list[np.ndarray]:
        """All regions that are not too small."""
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
    """Where the gripper is at the beginning of an episode."""

    point: tuple[float, float] = Field(
        default=(0.5, 0.0), description="the circle's centre: x in widths of the image, y in its heights, from top left"
    )
    radius: float = Field(default=0.25, gt=0, description="in shorter sides of the image")


class CircleSelector:
    """Regions that lie wholly in a circle: for a camera that stands still, and a robot that begins at home."""

    Config: ClassVar[type] = CircleConfig

    def __init__(self, config: CircleConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Nothing to load."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Those regions, whatever they show."""
        chosen = []
        for image, masks in zip(images, regions, strict=True):
            height, width = image.shape[:2]
            x, y = self._config.point[0] * width, self._config.point[1] * height
            v, u = np.mgrid[:height, :width] + 0.5
            outside = np.hypot(u - x, v - y) > self._config.radius * min(height, width)
            chosen.append([i for i, mask in enumerate(masks) if mask.any() and not (mask & outside).any()])
        return chosen
