"""A detector of colours, for simulations and tests: no weights."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from PIL import Image
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.parts import Found, Images
from vlagents_ray.policies.arro.regions import box_of, split

_HUES = {"red": 0.0, "orange": 28.0, "yellow": 48.0, "green": 132.0, "cyan": 180.0, "blue": 216.0, "purple": 275.0}


class ColourConfig(BaseModel, extra="forbid"):
    """Which words stand for which hues, and what counts as coloured."""

    hues: dict[str, float] = Field(default=_HUES, description="word -> hue in degrees")
    tolerance: float = Field(default=20.0, gt=0, le=180, description="degrees on both sides")
    saturation: float = Field(default=0.15, ge=0, le=1, description="the least, in HSV")
    value: float = Field(default=0.2, ge=0, le=1, description="the least, in HSV")
    smallest: float = Field(default=5e-4, ge=0, le=1, description="of a region, as a share of the image")


class ColourDetector:
    """Finds each connected region of the colours that a phrase names: all that is red for "lift the red puck"."""

    Config: ClassVar[type] = ColourConfig

    def __init__(self, config: ColourConfig) -> None:
        self._config = config

    def load(self) -> None:
        """Nothing to load."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Found]]:
        """Regions by their size; a phrase without a colour finds none."""
        return [self._found(image, asked) for image, asked in zip(images, phrases, strict=True)]

    def _found(self, image: np.ndarray, phrases: Sequence[str]) -> list[Found]:
        hue, saturation, value = np.moveaxis(np.asarray(Image.fromarray(image).convert("HSV"), np.float32), -1, 0)
        coloured = (saturation >= self._config.saturation * 255) & (value >= self._config.value * 255)
        found = []
        for phrase in phrases:
            for word in sorted(set(re.findall(r"\w+", phrase.lower())) & set(self._config.hues)):
                off = np.abs((hue * (360 / 256) - self._config.hues[word] + 180) % 360 - 180)
                for mask in split(coloured & (off <= self._config.tolerance), self._smallest(image)):
                    found.append(Found(phrase, box_of(mask), np.count_nonzero(mask) / mask.size, mask))
        return sorted(found, key=lambda one: -one.score)

    def _smallest(self, image: np.ndarray) -> int:
        return max(1, round(self._config.smallest * (image.size // 3)))
