"""The parts of ARRO. Each part is a class that takes an instance of its `Config`, and loads its weights in `load`.

A part is shared by all sessions of a replica and keeps no state of theirs; a tracker's memory of one session and camera
is a separate object, which can be pickled. Each part gets the images of several sessions at once, and its result for
one must not depend on the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained
from vlagents_ray.policies.base.config import DType
from vlagents_ray.registry import named_class, require

Images = Sequence[np.ndarray]  # (H, W, 3) uint8 RGB each, of any sizes

PARTS: dict[str, dict[str, str]] = {
    "detector": {
        "colour": "vlagents_ray.policies.arro.untrained:ColourDetector",
        "grounding_dino": "vlagents_ray.policies.arro.pretrained:GroundingDinoDetector",
    },
    "segmenter": {
        "flat": "vlagents_ray.policies.arro.untrained:FlatSegmenter",
        "sam2": "vlagents_ray.policies.arro.pretrained:Sam2Segmenter",
    },
    "selector": {"circle": "vlagents_ray.policies.arro.untrained:CircleSelector"},
    "tracker": {
        "iou": "vlagents_ray.policies.arro.untrained:IouTracker",
        "sam2": "vlagents_ray.policies.arro.pretrained:Sam2Tracker",
    },
}


@dataclass(frozen=True, slots=True)
class Detection:
    """A detected object."""

    phrase: str  # the requested phrase that it was detected for
    box: np.ndarray  # (4,) float32, px: left, top, right, bottom
    score: float
    mask: np.ndarray | None = None  # (H, W) bool, from a detector that provides masks; else the box is segmented


class Detector(Protocol):
    """Detects objects by phrases."""

    def load(self) -> None:
        """Read the weights."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return the objects of `phrases[i]` on `images[i]`, the best first."""
        ...


class Segmenter(Protocol):
    """Computes masks of objects."""

    def load(self) -> None:
        """Read the weights."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the mask of the object in each box: (N, H, W) bool for boxes (N, 4) px.

        All False where there is none.
        """
        ...

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return all regions that may be objects: (M, H, W) bool, which may overlap."""
        ...


class Selector(Protocol):
    """Selects the gripper's fingers."""

    def load(self) -> None:
        """Read the weights."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Return the indices of the regions (M, H, W) of each image that make up the gripper.

        None if it is not visible.
        """
        ...


class Tracker(Protocol):
    """Tracks segments from frame to frame."""

    def load(self) -> None:
        """Read the weights."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Return a memory of each image's segments, (N, H, W) bool with N >= 1, from which to track them."""
        ...

    def follow(self, images: Images, memories: Sequence[Any]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each next image, its segments (N, H, W) bool, and which of them are visible, (N,) bool.

        Updates the memories. The mask of a segment that is not visible is undefined.
        """
        ...


def make_part(kind: str, entry: str | Mapping[str, Mapping[str, Any]]) -> Any:
    """Create the part of a kind from a registered name or "module:Class", or {name: settings}; raises `ConfigError`."""
    named = {entry: {}} if isinstance(entry, str) else dict(entry)
    if len(named) != 1:
        raise ConfigError(f"{kind}: got {sorted(named)}, want one name with its settings")
    [(name, settings)] = named.items()
    cls = named_class(name, PARTS[kind])
    try:
        return cls(cls.Config(**(settings or {})))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{kind} {name!r}: {error}") from error


class PretrainedConfig(BaseModel, extra="forbid"):
    """The weights, and their device."""

    checkpoint: str = Field(min_length=1, description="a folder as transformers saves it, or a hub id: org/name@COMMIT")
    device: str = Field(default="auto", description="'auto' (an accelerator if there is one), 'cpu', 'cuda', 'cuda:1'")
    dtype: DType = Field(default="float32", description="of the weights")


def load_pretrained(model: str, processor: str, config: PretrainedConfig) -> tuple[Any, Any]:
    """Load a model and a processor by their class names in transformers.

    Raises `ConfigError` if anything is missing.
    """
    ensure_torchvision()
    transformers = require("transformers")
    path = find_checkpoint(config.checkpoint, needs=("config.json", "*.safetensors", "*processor_config.json"))
    device = torch_device(config.device)
    loaded = from_pretrained(getattr(transformers, model), path, dtype=torch_dtype(config.dtype, device))
    return loaded.to(device).eval(), getattr(transformers, processor).from_pretrained(path)


def writable(images: Images) -> list[np.ndarray]:
    """Return copies of the images: a server's are read-only, which torch warns about."""
    return [image.copy() for image in images]


def connected(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Label each pixel, (H, W) int; two pixels share a label if a chain of linked neighbours connects them.

    Args:
        right: (H, W - 1) bool, whether a pixel is linked to the next one in its row.
        down: (H - 1, W) bool, whether a pixel is linked to the one below it.
    """
    height, width = right.shape[0], down.shape[1]
    index = np.arange(height * width).reshape(height, width)
    one = np.concatenate([index[:, :-1][right], index[:-1][down]])
    other = np.concatenate([index[:, 1:][right], index[1:][down]])
    labels = index.ravel()
    while True:
        a, b = labels[one], labels[other]
        apart = a != b
        if not apart.any():
            return labels.reshape(height, width)
        np.minimum.at(labels, np.maximum(a, b)[apart], np.minimum(a, b)[apart])
        while not np.array_equal(labels, jumped := labels[labels]):
            labels = jumped


def split(mask: np.ndarray, smallest: int = 1) -> list[np.ndarray]:
    """Return the connected regions of `mask`, (H, W) bool each, of at least `smallest` pixels; the largest first."""
    labels = connected(mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:])
    return [labels == label for label in largest(labels[mask], smallest)]


def flat(image: np.ndarray, tolerance: int) -> np.ndarray:
    """Label each pixel, (H, W) int; neighbours that differ by at most `tolerance` in all channels share a label."""
    signed = image.astype(np.int16)
    return connected(*(np.abs(np.diff(signed, axis=axis)).max(-1) <= tolerance for axis in (1, 0)))


def largest(labels: np.ndarray, smallest: int) -> np.ndarray:
    """Return the labels of at least `smallest` pixels, the most frequent first."""
    values, counts = np.unique(labels, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    kept: np.ndarray = values[order[counts[order] >= smallest]]
    return kept


def box_of(mask: np.ndarray) -> np.ndarray:
    """Return the smallest box around the true pixels: (4,) float32, px: left, top, right, bottom."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Return the intersection over union of two masks; 0 if both are empty."""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Widen the mask by `pixels` to each side."""
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (pixels, pixels)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(mask, padding), 2 * pixels + 1, axis)
        mask = np.asarray(windows.any(-1))
    return mask
