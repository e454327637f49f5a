"""Images to H.264 in MP4, which browsers play."""

from __future__ import annotations

import contextlib
import io
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.registry import require


class Mp4:
    """One camera's video under way. At 224x224 a frame takes about 0.3 ms."""

    def __init__(
        self, target: io.BytesIO | Path, shape: tuple[int, ...], fps: float, *, key_frames: int | None = None
    ) -> None:
        """To a file, or into memory. `shape` is (H, W, 3); every `key_frames`-th frame can be sought (None: x264's)."""
        self._av: Any = require("av")
        self._shape = shape
        height, width = shape[:2]
        self._pad = (height % 2, width % 2)  # yuv420p halves both sides
        self._container = self._av.open(target if isinstance(target, io.BytesIO) else str(target), "w", format="mp4")
        options = {"preset": "ultrafast", "crf": "23", "threads": "1"}
        if key_frames is not None:
            options["g"] = str(key_frames)
        self._stream = self._container.add_stream(
            "libx264", rate=Fraction(fps).limit_denominator(1000), options=options
        )
        self._stream.height, self._stream.width = self.size
        self._stream.pix_fmt = "yuv420p"

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the video, both even: an odd image gets another row or column like its last."""
        return self._shape[0] + self._pad[0], self._shape[1] + self._pad[1]

    def add(self, image: np.ndarray) -> None:
        """Append an image, (H, W, 3) uint8 RGB; `InvalidObservation` if it is another one's size."""
        if image.shape != self._shape or image.dtype != np.uint8:
            raise InvalidObservation(f"got an image of {image.shape} {image.dtype}, want {self._shape} uint8 as before")
        if any(self._pad):
            image = np.pad(image, ((0, self._pad[0]), (0, self._pad[1]), (0, 0)), mode="edge")
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def finish(self) -> None:
        """Write what is left; the video is whole then."""
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def abandon(self) -> None:
        """Give the encoder back; the video is of no use, so it may be that its end cannot be written."""
        with contextlib.suppress(OSError):  # PyAV's errors of the disk are OSErrors
            self._container.close()
