"""What ARRO is made of. Each part is a class that takes an instance of its `Config` and, in `load`, its weights.

A part is shared by all sessions of a replica and keeps nothing of theirs; a tracker's memory of one
session and camera is an object of its own, which can be pickled. All get the images of several
sessions at once, and what they do with one must not depend on the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import named_class

Images = Sequence[np.ndarray]  # (H, W, 3) uint8 RGB each, of any sizes

PARTS: dict[str, dict[str, str]] = {
    "detector": {
        "colour": "vlagents_ray.policies.arro.colour:ColourDetector",
        "grounding_dino": "vlagents_ray.policies.arro.grounding_dino:GroundingDinoDetector",
    },
    "segmenter": {
        "flat": "vlagents_ray.policies.arro.flat:FlatSegmenter",
        "sam2": "vlagents_ray.policies.arro.sam2:Sam2Segmenter",
    },
    "selector": {"circle": "vlagents_ray.policies.arro.flat:CircleSelector"},
    "tracker": {
        "iou": "vlagents_ray.policies.arro.iou:IouTracker",
        "sam2": "vlagents_ray.policies.arro.sam2:Sam2Tracker",
    },
}


@dataclass(frozen=True, slots=True)
class Found:
    """A thing on an image."""

    phrase: str  # of those that were asked for, the one that it goes by
    box: np.ndarray  # (4,) float32, px: left, top, right, bottom
    score: float
    mask: np.ndarray | None = None  # (H, W) bool, from a detector that knows the pixels; else they are segmented


class Detector(Protocol):
    """Finds things by words."""

    def load(self) -> None:
        """Read the weights."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Found]]:
        """What there is of `phrases[i]` on `images[i]`, the best first."""
        ...


class Segmenter(Protocol):
    """Cuts things out."""

    def load(self) -> None:
        """Read the weights."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The thing in each box: (N, H, W) bool for boxes (N, 4) px; nowhere true where there is none."""
        ...

    def propose(self, images: Images) -> list[np.ndarray]:
        """All regions that may be things: (M, H, W) bool, which may overlap."""
        ...


class Selector(Protocol):
    """Chooses the gripper's fingers."""

    def load(self) -> None:
        """Read the weights."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Which of the regions (M, H, W) of each image make up the gripper; none if it is not to be seen."""
        ...


class Tracker(Protocol):
    """Follows segments from frame to frame."""

    def load(self) -> None:
        """Read the weights."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """A memory of each image's segments, (N, H, W) bool with N >= 1, to follow them from here."""
        ...

    def follow(self, images: Images, memories: Sequence[Any]) -> list[tuple[np.ndarray, np.ndarray]]:
        """For each next image its segments (N, H, W) bool, and which of them are seen, (N,) bool.

        Changes the memories. The mask of a segment that is not seen means nothing.
        """
        ...


def make_part(kind: str, entry: str | Mapping[str, Mapping[str, Any]]) -> Any:
    """The part of that kind, from a registered name or "module:Class", or {name: settings}. Raises `ConfigError`."""
    named = {entry: {}} if isinstance(entry, str) else dict(entry)
    if len(named) != 1:
        raise ConfigError(f"{kind}: got {sorted(named)}, want one name with its settings")
    [(name, settings)] = named.items()
    cls = named_class(name, PARTS[kind])
    try:
        return cls(cls.Config(**(settings or {})))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{kind} {name!r}: {error}") from error
