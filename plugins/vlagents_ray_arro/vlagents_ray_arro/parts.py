"""The parts of ARRO. Each part is a class that takes an instance of its `Config`, and loads its
weights in `load`.

All sessions of a replica share a part, which keeps none of their state; a tracker's memory of one
session and camera is a separate object, which can be pickled. Each part gets the images of several
sessions at once, and its result for one must not depend on the others.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from PIL import Image
from pydantic import BaseModel, Field

from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained
from vlagents_ray.policies.base.config import DType
from vlagents_ray.registry import named_class, require

Images = Sequence[np.ndarray]  # (H, W, 3) uint8 RGB each, of any sizes

PARTS: dict[str, dict[str, str]] = {
    "detector": {
        "colour": "vlagents_ray_arro.parts:ColourDetector",
        "grounding_dino": "vlagents_ray_arro.pretrained:GroundingDinoDetector",
    },
    "segmenter": {
        "flat": "vlagents_ray_arro.parts:FlatSegmenter",
        "sam2": "vlagents_ray_arro.pretrained:Sam2Segmenter",
    },
    "selector": {"circle": "vlagents_ray_arro.parts:CircleSelector"},
    "tracker": {
        "iou": "vlagents_ray_arro.parts:IouTracker",
        "sam2": "vlagents_ray_arro.pretrained:Sam2Tracker",
    },
}


@dataclass(frozen=True, slots=True)
class Detection:
    """A detected object."""

    phrase: str  # the requested phrase that it was detected for
    box: np.ndarray  # (4,) float32, px: left, top, right, bottom
    score: float
    # (H, W) bool, from a detector that provides masks; else the box is segmented.
    mask: np.ndarray | None = None


class Part(Protocol):
    """A part, which is made with an instance of its `Config`."""

    def load(self) -> None:
        """Read the weights; raises `ConfigError` if some are missing."""


class Detector(Part, Protocol):
    """Detects objects by phrases."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return the objects of `phrases[i]` on `images[i]`, the best first."""
        ...


class Segmenter(Part, Protocol):
    """Computes masks of objects."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the mask of the object in each box, (N, H, W) bool for boxes (N, 4) px; all
        False for none.
        """
        ...

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return all regions that may be objects: (M, H, W) bool, which may overlap."""
        ...


class Selector(Part, Protocol):
    """Selects the gripper's fingers."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Return the indices of the regions (M, H, W) of each image that make up the gripper;
        none if it is hidden.
        """
        ...


class Tracker(Part, Protocol):
    """Tracks segments from frame to frame."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Return a memory of each image's segments, (N, H, W) bool with N >= 1, from which to
        track them.
        """
        ...

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return, for each next image, its segments (N, H, W) bool, and which of them are visible,
        (N,) bool.

        Updates the memories. The mask of a segment that is not visible is undefined.
        """
        ...


def make_part(kind: str, entry: str | Mapping[str, Mapping[str, Any]]) -> Any:
    """Create the part of a kind from a registered name or "module:Class", or {name: settings};
    raises `ConfigError`.
    """
    named = {entry: {}} if isinstance(entry, str) else dict(entry)
    if len(named) != 1:
        raise ConfigError(f"{kind}: got {sorted(named)}, want one name with its settings")
    [(name, settings)] = named.items()
    registered = PARTS[kind]
    target = registered.get(name, name)
    if ":" not in target:
        cure = did_you_mean(name, registered)
        raise ConfigError(
            f"{kind}: expected one of {sorted(registered)}, or 'module:Class', got {name!r}{cure}"
        )
    cls = named_class(target)
    try:
        return cls(cls.Config(**(settings or {})))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{kind} {name!r}: {error}") from error


class PretrainedConfig(BaseModel, extra="forbid"):
    """The weights, and their device."""

    checkpoint: str = Field(
        min_length=1, description="a folder as transformers saves it, or a hub id: org/name@COMMIT"
    )
    device: str = Field(
        default="auto",
        description="'auto' (an accelerator if there is one), 'cpu', 'cuda', 'cuda:1'",
    )
    dtype: DType = Field(default="float32", description="of the weights")


class Pretrained:
    """A part with a model and a processor of transformers."""

    classes: ClassVar[tuple[str, str]]  # of the model and of the processor

    def __init__(self, config: Any) -> None:
        self._config = config
        self._model: Any = None
        self._processor: Any = None

    def load(self) -> None:
        """Read the weights; raises `ConfigError` if some are missing."""
        ensure_torchvision()
        transformers, config = require("transformers"), self._config
        model, processor = (getattr(transformers, name) for name in self.classes)
        path = find_checkpoint(
            config.checkpoint, needs=("config.json", "*.safetensors", "*processor_config.json")
        )
        device = torch_device(config.device)
        loaded = from_pretrained(model, path, dtype=torch_dtype(config.dtype, device))
        self._model, self._processor = loaded.to(device).eval(), processor.from_pretrained(path)


class Untrained:
    """A part without weights."""

    def __init__(self, config: Any) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing."""


def writable(images: Images) -> list[np.ndarray]:
    """Return copies of the images: a server's are read-only, which torch warns about."""
    return [image.copy() for image in images]


def connected(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Label each pixel, (H, W) int; two pixels share a label if a chain of linked neighbours
    connects them.

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
    """Return the connected regions of `mask`, (H, W) bool each, of at least `smallest` pixels;
    the largest first.
    """
    labels = connected(mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:])
    return [labels == label for label in largest(labels[mask], smallest)]


def flat(image: np.ndarray, tolerance: int) -> np.ndarray:
    """Label each pixel, (H, W) int; neighbours that differ by at most `tolerance` in all
    channels share a label.
    """
    signed = image.astype(np.int16)
    return connected(*(np.abs(np.diff(signed, axis=axis)).max(-1) <= tolerance for axis in (1, 0)))


def largest(labels: np.ndarray, smallest: int) -> np.ndarray:
    """Return the labels of at least `smallest` pixels, the most frequent first."""
    values, counts = np.unique(labels, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    kept: np.ndarray = values[order[counts[order] >= smallest]]
    return kept


def box_of(mask: np.ndarray) -> np.ndarray:
    """Return the smallest box around the true pixels: (4,) float32, px: left, top, right,
    bottom.
    """
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
        windows = np.lib.stride_tricks.sliding_window_view(
            np.pad(mask, padding), 2 * pixels + 1, axis
        )
        mask = np.asarray(windows.any(-1))
    return mask


_HUES = {
    "red": 0.0,
    "orange": 28.0,
    "yellow": 48.0,
    "green": 132.0,
    "cyan": 180.0,
    "blue": 216.0,
    "purple": 275.0,
}


class ColourConfig(BaseModel, extra="forbid"):
    """The hue of each word, and which pixels count as coloured."""

    hues: dict[str, float] = Field(default=_HUES, description="word -> hue in degrees")
    tolerance: float = Field(default=20.0, gt=0, le=180, description="degrees on both sides")
    saturation: float = Field(default=0.15, ge=0, le=1, description="the least, in HSV")
    value: float = Field(default=0.2, ge=0, le=1, description="the least, in HSV")
    smallest: float = Field(
        default=5e-4, ge=0, le=1, description="of a region, as a share of the image"
    )


class ColourDetector(Untrained):
    """Detects each connected region of the colours in a phrase: all that is red for "lift the
    red puck".
    """

    Config: ClassVar[type] = ColourConfig

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        return [
            self._detections(image, asked) for image, asked in zip(images, phrases, strict=True)
        ]

    def _detections(self, image: np.ndarray, phrases: Sequence[str]) -> list[Detection]:
        hue, saturation, value = np.moveaxis(
            np.asarray(Image.fromarray(image).convert("HSV"), np.float32), -1, 0
        )
        coloured = (saturation >= self._config.saturation * 255) & (
            value >= self._config.value * 255
        )
        smallest = max(1, round(self._config.smallest * hue.size))
        found = []
        for phrase in phrases:
            for word in sorted(set(re.findall(r"\w+", phrase.lower())) & set(self._config.hues)):
                off = np.abs((hue * (360 / 256) - self._config.hues[word] + 180) % 360 - 180)
                for mask in split(coloured & (off <= self._config.tolerance), smallest):
                    found.append(
                        Detection(phrase, box_of(mask), np.count_nonzero(mask) / mask.size, mask)
                    )
        return sorted(found, key=lambda one: -one.score)


class FlatConfig(BaseModel, extra="forbid"):
    """The criteria of a region."""

    tolerance: int = Field(
        default=8, ge=0, le=255, description="of neighbouring pixels, in every channel"
    )
    smallest: float = Field(
        default=2e-4, ge=0, le=1, description="of a proposed region, as a share of the image"
    )
    most: int = Field(default=256, ge=1, description="regions that are proposed, the largest first")


class FlatSegmenter(Untrained):
    """Finds regions within which the colour changes little from pixel to pixel."""

    Config: ClassVar[type] = FlatConfig

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [self._inside(image, around) for image, around in zip(images, boxes, strict=True)]

    def propose(self, images: Images) -> list[np.ndarray]:
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
        chosen = largest(labels, max(1, round(self._config.smallest * labels.size)))[
            : self._config.most
        ]
        return np.asarray(labels == chosen[:, None, None])


class CircleConfig(BaseModel, extra="forbid"):
    """The position of the gripper at the beginning of an episode."""

    point: tuple[float, float] = Field(
        default=(0.5, 0.0),
        description="the circle's centre: x in widths of the image, y in its heights, from top "
        "left",
    )
    radius: float = Field(default=0.25, gt=0, description="in shorter sides of the image")


class CircleSelector(Untrained):
    """Selects regions that lie wholly in a circle: for a fixed camera, and a robot that begins
    at home.
    """

    Config: ClassVar[type] = CircleConfig

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        chosen = []
        for image, masks in zip(images, regions, strict=True):
            height, width = image.shape[:2]
            x, y = self._config.point[0] * width, self._config.point[1] * height
            v, u = np.mgrid[:height, :width] + 0.5
            outside = np.hypot(u - x, v - y) > self._config.radius * min(height, width)
            chosen.append(
                [i for i, mask in enumerate(masks) if mask.any() and not (mask & outside).any()]
            )
        return chosen


_SHADES = 16  # levels of each channel


class IouConfig(BaseModel, extra="forbid"):
    """The distance that a segment may move, and the share of it that must remain visible."""

    reach: float = Field(
        default=0.1, ge=0, le=1, description="to each side a frame, in shorter sides of the image"
    )
    least: float = Field(
        default=0.2,
        gt=0,
        le=1,
        description="a region with a smaller share of its first pixels: lost",
    )
    most: float = Field(
        default=3.0, ge=1, description="a region with a larger multiple of them: something else"
    )


@dataclass(slots=True)
class _Segment:
    # (4096,) bool: colours with a greater share in the segment than in the rest of the first frame.
    colours: np.ndarray
    pixels: int  # on the first frame
    mask: np.ndarray  # (H, W) bool, its last visible position


class IouTracker(Untrained):
    """Tracks the connected region in a segment's colours that best overlaps the segment's last
    position.
    """

    Config: ClassVar[type] = IouConfig

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        return [
            [
                _Segment(_own_colours(shades, mask), int(np.count_nonzero(mask)), mask.copy())
                for mask in own
            ]
            for shades, own in zip(map(_shades, images), masks, strict=True)
        ]

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
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
        window = (
            slice(max(top - reach, 0), bottom + reach),
            slice(max(left - reach, 0), right + reach),
        )
        last = segment.mask[window]
        alike = split(
            segment.colours[shades[window]], max(1, round(self._config.least * segment.pixels))
        )
        regions = [
            region
            for region in alike
            if np.count_nonzero(region) <= self._config.most * segment.pixels
        ]
        if not regions:
            return False
        mask = np.zeros_like(segment.mask)
        # the nearest region where none overlaps: a small object moves by more than its own size
        mask[window] = max(
            regions, key=lambda region: (overlap(region, last), -_distance(region, last))
        )
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
