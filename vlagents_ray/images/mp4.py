"""Videos: an encoder of H.264 in MP4, which browsers can play, and the conversion of decoded
frames to images.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.registry import require


@contextlib.contextmanager
def read_mp4(file: Path, most_pixels: int) -> Iterator[Any]:
    """Open an MP4 file, which anybody may have written, and yield its container.

    FFmpeg would otherwise open whatever the content looks like, among others lists of other files
    and of addresses.

    Args:
        file: The file.
        most_pixels: The largest number of pixels of a frame.

    Raises:
        ConfigError: The file is no MP4, has no video, or larger frames.
    """
    av: Any = require("av")
    try:
        container = av.open(str(file), format="mp4", options={"protocol_whitelist": "file"})
    except (av.error.FFmpegError, OSError) as error:
        raise ConfigError(f"{file}: expected an MP4 file, got an error ({error})") from error
    with container:
        if not container.streams.video:
            raise ConfigError(f"{file}: expected a video, got none; is the file complete?")
        stream = container.streams.video[0]
        if stream.width * stream.height > most_pixels:
            raise ConfigError(
                f"{file}: expected at most {most_pixels} pixels in a frame, got "
                f"{stream.width}x{stream.height}"
            )
        yield container


def rgb_converter() -> Callable[[Any], np.ndarray]:
    """Return a function that converts the decoded frames of one video to images, (H, W, 3) uint8
    RGB.

    The function reuses its tables and threads. The method `to_ndarray` of a frame creates them for
    each frame, which takes at least 0.25 ms.
    """
    reformat = require("av").video.reformatter.VideoReformatter().reformat
    return lambda frame: reformat(frame, format="rgb24").to_ndarray()


class Mp4:
    """A video of one camera that is being written.

    Encoding a frame of 224x224 takes about 0.3 ms.
    """

    def __init__(
        self,
        target: io.BytesIO | Path,
        shape: tuple[int, ...],
        fps: float,
        *,
        key_frames: int | None = None,
        lossless: bool = False,
    ) -> None:
        """Open a video.

        Args:
            target: The file, or a buffer in memory.
            shape: The shape of its images, (H, W, 3).
            fps: The rate of the frames, Hz.
            key_frames: The number of frames from one key frame to the next; None selects x264's
                default.
            lossless: Whether to keep each pixel unchanged, in RGB. Such a video is about ten times
                larger, and browsers cannot play it.
        """
        self._av: Any = require("av")
        self._error: OSError | None = None  # the error that ended the video
        self._shape = shape
        height, width = shape[:2]
        # The pixel format yuv420p halves both dimensions, so these must be even.
        self._pad = (0, 0) if lossless else (height % 2, width % 2)
        file = target if isinstance(target, io.BytesIO) else str(target)
        self._container = self._av.open(file, "w", format="mp4")

        options = {"preset": "ultrafast", "threads": "1"}
        if lossless:
            options["qp"] = "0"
        else:
            options["crf"] = "23"
        if key_frames is not None:
            options["g"] = str(key_frames)
        self._stream = self._container.add_stream(
            "libx264rgb" if lossless else "libx264",
            rate=Fraction(fps).limit_denominator(1000),
            options=options,
        )

        # Unless the video is lossless, the last row or column of an image with an odd size is
        # repeated.
        self.size = self._stream.height, self._stream.width = (
            height + self._pad[0],
            width + self._pad[1],
        )
        self._stream.pix_fmt = "rgb24" if lossless else "yuv420p"

    def add(self, image: np.ndarray) -> None:
        """Append an image, (H, W, 3) uint8 RGB; raises `InvalidObservation` if its shape
        differs.
        """
        if image.shape != self._shape or image.dtype != np.uint8:
            raise InvalidObservation(
                f"expected {self._shape} uint8 as before, got {image.shape} {image.dtype}"
            )
        if any(self._pad):
            image = np.pad(image, ((0, self._pad[0]), (0, self._pad[1]), (0, 0)), mode="edge")
        self._write(self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24"))

    def finish(self) -> None:
        """Write the remaining frames and complete the file."""
        self._write(None)
        self._container.close()

    def _write(self, frame: Any) -> None:
        """Encode and write a frame; None writes the frames in the encoder.

        Raises:
            OSError: The disk is full, now or at an earlier frame: FFmpeg crashes if it continues
                a file whose header was not written.
        """
        if self._error is not None:
            raise self._error
        try:
            self._container.mux(self._stream.encode(frame))
        except OSError as error:  # PyAV raises disk errors as OSErrors
            self._error = error
            raise

    def abandon(self) -> None:
        """Close the encoder without completing the video.

        Errors while writing its end are ignored.
        """
        with contextlib.suppress(OSError):
            self._container.close()
