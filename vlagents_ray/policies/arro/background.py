"""The virtual background."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, model_validator
from typing_extensions import Self

from vlagents_ray.errors import ConfigError

Channel = int
Colour = tuple[Channel, Channel, Channel]  # RGB, 0 to 255


class BackgroundConfig(BaseModel, extra="forbid"):
    """A colour, optionally with a grid on it, or an image, as in the policy's training."""

    colour: Colour = (0, 0, 0)
    grid: Colour | None = Field(default=None, description="colour of the grid's lines, one pixel wide; unset: no grid")
    spacing: float = Field(default=0.1, gt=0, le=1, description="of the grid's lines, in shorter sides of the image")
    image: Path | None = Field(default=None, description="a file that is stretched to each camera's size")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for colour in (self.colour, self.grid or self.colour):
            if not all(0 <= channel <= 255 for channel in colour):
                raise ValueError(f"got colour {list(colour)}, want red, green and blue from 0 to 255")
        if self.image is not None and self.model_fields_set & {"colour", "grid", "spacing"}:
            raise ValueError("image excludes colour, grid and spacing; keep one or the other")
        return self


class Background:
    """Pastes segments onto the background."""

    def __init__(self, config: BackgroundConfig) -> None:
        self._config = config
        self._drawn: dict[tuple[int, int], np.ndarray] = {}

    def load(self) -> None:
        """Raise `ConfigError` if an image is configured that cannot be read."""
        self._draw(1, 1)

    def behind(self, image: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return a new image: `image`, (H, W, 3) uint8, where `mask`, (H, W) bool, is True, and the background
        elsewhere.
        """
        height, width = mask.shape
        if (height, width) not in self._drawn:
            self._drawn[height, width] = self._draw(height, width)
        return np.where(mask[..., None], image, self._drawn[height, width])

    def _draw(self, height: int, width: int) -> np.ndarray:
        config = self._config
        if config.image is not None:
            return _read(config.image, height, width)
        drawn = np.full((height, width, 3), config.colour, np.uint8)
        if config.grid is not None:
            step = max(2, round(config.spacing * min(height, width)))
            drawn[step // 2 :: step] = config.grid
            drawn[:, step // 2 :: step] = config.grid
        return drawn


def _read(path: Path, height: int, width: int) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path.expanduser()) as image:
            return np.asarray(image.convert("RGB").resize((width, height), Image.Resampling.BILINEAR))
    except (OSError, UnidentifiedImageError) as error:
        raise ConfigError(
            f"background.image {str(path)!r}: cannot be read as an image ({error}); check the path"
        ) from error
