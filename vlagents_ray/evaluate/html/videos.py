"""Videos of a report: beside it, inside it up to a budget, or none."""

from __future__ import annotations

import base64
import collections
import os
from pathlib import Path
from typing import Literal
from urllib.parse import quote

import numpy as np

from vlagents_ray.evaluate.html.elements import Html, tag
from vlagents_ray.images import encode_jpeg
from vlagents_ray.registry import require

Videos = Literal["inline", "link", "none"]

BUDGET = 24 * 2**20  # bytes of videos that one page carries
POSTER = 224  # the most pixels of a poster's side


class Gallery:
    """How the page at `page` shows the videos in `out`, and what of its budget is spent."""

    def __init__(self, out: Path, page: Path, mode: Videos, budget: int = BUDGET) -> None:
        self._out = out
        self._page = page
        self._mode = mode
        self._budget = budget
        self.inlined = 0
        self.linked = 0

    def show(self, video: str, label: str) -> Html | None:
        """A player for `video`, relative to `out`, with its last frame as poster; None if it is not there."""
        path = self._out / video
        if not path.is_file():
            return None
        still = poster(path)
        if self._mode == "none":
            return tag("img", src=still, alt=f"{label}: the last frame", loading="lazy") if still else None
        return tag(
            "video", src=self._source(path), poster=still, controls=True, muted=True, playsinline=True, preload="none",
            aria_label=label,
        )  # fmt: skip

    def link(self, video: str) -> str | None:
        """Where the page finds the file; None if it has none to link to."""
        path = self._out / video
        if self._mode == "none" or not path.is_file():
            return None
        return quote(Path(os.path.relpath(path.resolve(), self._page.parent.resolve())).as_posix())

    def _source(self, path: Path) -> str | None:
        size = path.stat().st_size
        if self._mode == "inline" and size <= self._budget:
            self._budget -= size
            self.inlined += 1
            return data_url("video/mp4", path.read_bytes())
        self.linked += 1
        return self.link(str(path.relative_to(self._out)))


def poster(video: Path) -> str | None:
    """The last frame as a data: URL of a JPEG; None for a file that does not play."""
    av = require("av")
    try:
        with av.open(str(video)) as container:
            frames = collections.deque(container.decode(video=0), maxlen=1)
    except (OSError, ValueError):  # PyAV's errors of broken files are of these kinds
        return None
    if not frames:
        return None
    image = np.asarray(frames[0].to_ndarray(format="rgb24"))
    stride = -(-max(image.shape[:2]) // POSTER)
    return data_url("image/jpeg", encode_jpeg(np.ascontiguousarray(image[::stride, ::stride]), quality=75))


def data_url(kind: str, data: bytes) -> str:
    """`data` as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
