"""The parts of ARRO: detectors, segmenters, selectors and trackers.

Each part is a class that is constructed with an instance of its `Config`, and loads its weights in
`load`. All sessions of a replica share a part. The part stores no state of sessions: a tracker's
memory of one session and camera is a separate object, which can be pickled. A part processes the
images of several sessions at once, and its result for one image must not depend on the others.
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

Images = Sequence[np.ndarray]  # images of any sizes, (H, W, 3) uint8 RGB each

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

    phrase: str  # requested phrase for which the object was detected
    box: np.ndarray  # (4,) float32, px: left, top, right, bottom
    score: float
    # The mask, (H, W) bool; None from a detector without masks, whose boxes are segmented.
    mask: np.ndarray | None = None


class Part(Protocol):
    """A part, which is constructed with an instance of its `Config`."""

    def load(self) -> None:
        """Read the weights; raises `ConfigError` if some are missing."""


class Detector(Part, Protocol):
    """Detects objects that phrases describe."""

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Detect objects on each image.

        Args:
            images: The images.
            phrases: The phrases of the objects to detect on each image.

        Returns:
            The objects on each image, the best first.
        """
        ...


class Segmenter(Part, Protocol):
    """Computes masks of objects."""

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Compute the mask of the object in each box.

        Args:
            images: The images.
            boxes: The boxes on each image, (N, 4) px: left, top, right, bottom.

        Returns:
            The masks on each image, (N, H, W) bool. The mask of a box without an object is all
            False.
        """
        ...

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return regions of each image that may be objects, (M, H, W) bool. Regions may overlap."""
        ...


class Selector(Part, Protocol):
    """Selects the gripper's fingers."""

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Select the regions that make up the gripper.

        Args:
            images: The images.
            regions: The regions of each image, (M, H, W) bool.

        Returns:
            The indices of the selected regions of each image; none if the gripper is hidden.
        """
        ...


class Tracker(Part, Protocol):
    """Tracks segments from frame to frame."""

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Begin to track the segments of each image.

        Args:
            images: The images.
            masks: The segments of each image, (N, H, W) bool with N >= 1.

        Returns:
            A memory for each image, with which `follow` tracks the image's segments.
        """
        ...

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Track segments to the next frame.

        Args:
            images: The next image of each memory.
            memories: The memories of `begin`, which are updated.

        Returns:
            The segments of each image, (N, H, W) bool, and which segments are visible, (N,) bool.
            The mask of a segment that is not visible is undefined.
        """
        ...


def make_part(kind: str, entry: str | Mapping[str, Mapping[str, Any]]) -> Any:
    """Create a part, without its weights.

    Args:
        kind: "detector", "segmenter", "selector" or "tracker".
        entry: A registered name or "module:Class", or {name: settings}.

    Returns:
        The part.

    Raises:
        ConfigError: The name is unknown, or a setting is wrong.
    """
    settings_by_name = {entry: {}} if isinstance(entry, str) else dict(entry)
    if len(settings_by_name) != 1:
        raise ConfigError(
            f"{kind}: expected one name with its settings, got {sorted(settings_by_name)}"
        )
    [(name, settings)] = settings_by_name.items()
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
    dtype: DType = Field(default="float32", description="dtype of the weights")


class Pretrained:
    """A part with a model and a processor of transformers."""

    classes: ClassVar[tuple[str, str]]  # classes of the model and of the processor

    def __init__(self, config: Any) -> None:
        self._config = config
        self._model: Any = None
        self._processor: Any = None

    def load(self) -> None:
        """Read the weights; raises `ConfigError` if some are missing."""
        ensure_torchvision()
        transformers, config = require("transformers"), self._config
        model_class, processor_class = (getattr(transformers, name) for name in self.classes)
        path = find_checkpoint(
            config.checkpoint, needs=("config.json", "*.safetensors", "*processor_config.json")
        )
        device = torch_device(config.device)
        model = from_pretrained(model_class, path, dtype=torch_dtype(config.dtype, device))
        self._model = model.to(device).eval()
        self._processor = processor_class.from_pretrained(path)


class Untrained:
    """A part without weights."""

    def __init__(self, config: Any) -> None:
        self._config = config

    def load(self) -> None:
        """Do nothing."""


def writable(images: Images) -> list[np.ndarray]:
    """Return copies of the images, since torch warns about read-only images, such as those of a
    server.
    """
    return [image.copy() for image in images]


def label_linked(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Label pixels. Two pixels have the same label if a chain of linked neighbours connects them.

    Args:
        right: (H, W - 1) bool, whether a pixel is linked to the next one in its row.
        down: (H - 1, W) bool, whether a pixel is linked to the one below it.

    Returns:
        The labels, (H, W) int.
    """
    height, width = right.shape[0], down.shape[1]
    index = np.arange(height * width).reshape(height, width)
    # The two pixels of each link.
    first = np.concatenate([index[:, :-1][right], index[:-1][down]])
    second = np.concatenate([index[:, 1:][right], index[1:][down]])

    # Each label is the index of a pixel with the same or a smaller label, so that the labels form
    # trees. Each round joins the trees of linked pixels, and then flattens all trees.
    labels = index.ravel()
    while True:
        first_labels, second_labels = labels[first], labels[second]
        differ = first_labels != second_labels
        if not differ.any():
            return labels.reshape(height, width)

        larger = np.maximum(first_labels, second_labels)[differ]
        smaller = np.minimum(first_labels, second_labels)[differ]
        np.minimum.at(labels, larger, smaller)
        flattened = labels[labels]
        while not np.array_equal(labels, flattened):
            labels, flattened = flattened, flattened[flattened]


def connected_regions(mask: np.ndarray, smallest: int = 1) -> list[np.ndarray]:
    """Divide a mask into its connected regions.

    Args:
        mask: (H, W) bool.
        smallest: The smallest number of pixels of a region.

    Returns:
        The regions, (H, W) bool each, the largest first.
    """
    labels = label_linked(mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:])
    return [labels == label for label in frequent_labels(labels[mask], smallest)]


def label_flat(image: np.ndarray, tolerance: int) -> np.ndarray:
    """Label pixels. Similar neighbours have the same label.

    Args:
        image: (H, W, 3) uint8.
        tolerance: The largest difference of similar neighbours in any channel.

    Returns:
        The labels, (H, W) int.
    """
    signed = image.astype(np.int16)
    right = np.abs(np.diff(signed, axis=1)).max(-1) <= tolerance
    down = np.abs(np.diff(signed, axis=0)).max(-1) <= tolerance
    return label_linked(right, down)


def frequent_labels(labels: np.ndarray, smallest: int) -> np.ndarray:
    """Return the labels of at least `smallest` pixels, the most frequent first."""
    values, counts = np.unique(labels, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    frequent: np.ndarray = values[order[counts[order] >= smallest]]
    return frequent


def bounding_box(mask: np.ndarray) -> np.ndarray:
    """Return the smallest box around the true pixels of a mask (H, W): (4,) float32, px: left,
    top, right, bottom.
    """
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection over union of two masks (H, W) bool; 0 if both are empty."""
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 0.0


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Return a mask (H, W) bool whose true area is `pixels` wider on each side."""
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
    """The hue of each word, and the criteria of coloured pixels."""

    hues: dict[str, float] = Field(default=_HUES, description="word -> hue in degrees")
    tolerance: float = Field(
        default=20.0, gt=0, le=180, description="largest difference from a hue, in degrees"
    )
    saturation: float = Field(
        default=0.15, ge=0, le=1, description="least saturation of a coloured pixel, in HSV"
    )
    value: float = Field(
        default=0.2, ge=0, le=1, description="least value of a coloured pixel, in HSV"
    )
    smallest: float = Field(
        default=5e-4, ge=0, le=1, description="size of the smallest region, as a share of the image"
    )


class ColourDetector(Untrained):
    """Detects all connected regions in the colours of a phrase, such as all red regions for "lift
    the red puck".
    """

    Config: ClassVar[type] = ColourConfig

    def detect(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Detection]]:
        """Return the coloured regions of each image with their masks, the largest region first."""
        return [
            self._detections(image, image_phrases)
            for image, image_phrases in zip(images, phrases, strict=True)
        ]

    def _detections(self, image: np.ndarray, phrases: Sequence[str]) -> list[Detection]:
        config = self._config
        # Value of the pixels, 0 to 255.
        hsv = np.asarray(Image.fromarray(image).convert("HSV"), np.float32)
        hue, saturation, value = np.moveaxis(hsv, -1, 0)
        is_coloured = (saturation >= config.saturation * 255) & (value >= config.value * 255)
        smallest = max(1, round(config.smallest * hue.size))

        detections = []
        for phrase in phrases:
            words = set(re.findall(r"\w+", phrase.lower()))
            for word in sorted(words & set(config.hues)):
                difference = np.abs((hue * (360 / 256) - config.hues[word] + 180) % 360 - 180)
                has_colour = is_coloured & (difference <= config.tolerance)
                for mask in connected_regions(has_colour, smallest):
                    share = np.count_nonzero(mask) / mask.size
                    detections.append(Detection(phrase, bounding_box(mask), share, mask))
        return sorted(detections, key=lambda detection: -detection.score)


class FlatConfig(BaseModel, extra="forbid"):
    """The criteria of a region."""

    tolerance: int = Field(
        default=8,
        ge=0,
        le=255,
        description="largest difference of neighbouring pixels, in every channel",
    )
    smallest: float = Field(
        default=2e-4,
        ge=0,
        le=1,
        description="size of the smallest proposed region, as a share of the image",
    )
    most: int = Field(
        default=256, ge=1, description="largest number of proposed regions, the largest ones first"
    )


class FlatSegmenter(Untrained):
    """Finds regions within which the colour changes little from pixel to pixel."""

    Config: ClassVar[type] = FlatConfig

    def segment(self, images: Images, boxes: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the union of all regions that lie completely in each box, as one mask for each
        box.
        """
        return [
            self._inside(image, image_boxes)
            for image, image_boxes in zip(images, boxes, strict=True)
        ]

    def propose(self, images: Images) -> list[np.ndarray]:
        """Return the regions of each image, the largest first."""
        return [self._regions(image) for image in images]

    def _inside(self, image: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        labels = label_flat(image, self._config.tolerance)
        masks = np.zeros((len(boxes), *labels.shape), bool)
        for i, (left, top, right, bottom) in enumerate(np.rint(boxes).astype(int).clip(0)):
            in_box = np.zeros(labels.shape, bool)
            in_box[top:bottom, left:right] = True
            extends_beyond = np.isin(labels, labels[~in_box])
            masks[i] = in_box & ~extends_beyond
        return masks

    def _regions(self, image: np.ndarray) -> np.ndarray:
        labels = label_flat(image, self._config.tolerance)
        smallest = max(1, round(self._config.smallest * labels.size))
        proposed = frequent_labels(labels, smallest)[: self._config.most]
        return np.asarray(labels == proposed[:, None, None])


class CircleConfig(BaseModel, extra="forbid"):
    """The position of the gripper at the beginning of an episode."""

    point: tuple[float, float] = Field(
        default=(0.5, 0.0),
        description="the circle's centre: x in widths of the image, y in its heights, from the top "
        "left corner",
    )
    radius: float = Field(
        default=0.25, gt=0, description="the circle's radius, in shorter sides of the image"
    )


class CircleSelector(Untrained):
    """Selects the regions that lie completely in a circle.

    This is for a fixed camera, and a robot that begins each episode in its home position.
    """

    Config: ClassVar[type] = CircleConfig

    def select(self, images: Images, regions: Sequence[np.ndarray]) -> list[list[int]]:
        """Return the indices of the regions of each image that lie completely in the circle."""
        selected = []
        for image, masks in zip(images, regions, strict=True):
            outside = self._outside(*image.shape[:2])
            indices = []
            for i, mask in enumerate(masks):
                if mask.any() and not (mask & outside).any():
                    indices.append(i)
            selected.append(indices)
        return selected

    def _outside(self, height: int, width: int) -> np.ndarray:
        """Return which pixels lie outside of the circle, (height, width) bool."""
        centre_x = self._config.point[0] * width
        centre_y = self._config.point[1] * height
        y, x = np.mgrid[:height, :width] + 0.5
        distance = np.hypot(x - centre_x, y - centre_y)
        return np.asarray(distance > self._config.radius * min(height, width))


_SHADES = 16  # number of levels of each channel


class IouConfig(BaseModel, extra="forbid"):
    """The distance that a segment may move, and the share of it that must remain visible."""

    reach: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="largest motion in a frame to each side, in shorter sides of the image",
    )
    least: float = Field(
        default=0.2,
        gt=0,
        le=1,
        description="a region with a smaller share of the segment's first pixels is ignored",
    )
    most: float = Field(
        default=3.0,
        ge=1,
        description="a region with a larger multiple of the segment's first pixels is ignored",
    )


@dataclass(slots=True)
class _Segment:
    # The typical colours of the segment, (4096,) bool: colours with a larger share in the segment
    # than in the other pixels of the first frame.
    colours: np.ndarray
    pixels: int  # number of pixels on the first frame
    mask: np.ndarray  # mask at the last visible position, (H, W) bool


class IouTracker(Untrained):
    """Tracks a segment as the connected region in the segment's colours that best overlaps its last
    position.
    """

    Config: ClassVar[type] = IouConfig

    def begin(self, images: Images, masks: Sequence[np.ndarray]) -> list[Any]:
        """Return the segments of each image with their colours."""
        memories = []
        for image, image_masks in zip(images, masks, strict=True):
            shades = _shades(image)
            segments = []
            for mask in image_masks:
                pixels = int(np.count_nonzero(mask))
                segments.append(_Segment(_typical_colours(shades, mask), pixels, mask.copy()))
            memories.append(segments)
        return memories

    def follow(
        self, images: Images, memories: Sequence[Any]
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the segments of each image, and which of them are visible."""
        followed = []
        for image, segments in zip(images, memories, strict=True):
            shades = _shades(image)
            visible = np.array([self._move(segment, shades) for segment in segments])
            masks = np.stack([segment.mask for segment in segments])
            followed.append((masks, visible))
        return followed

    def _move(self, segment: _Segment, shades: np.ndarray) -> bool:
        """Move a segment to its position on a frame; return False if it is not visible."""
        reach = round(self._config.reach * min(shades.shape))
        left, top, right, bottom = bounding_box(segment.mask).astype(int)
        window = (
            slice(max(top - reach, 0), bottom + reach),
            slice(max(left - reach, 0), right + reach),
        )
        last = segment.mask[window]

        smallest = max(1, round(self._config.least * segment.pixels))
        largest = self._config.most * segment.pixels
        regions = []
        for region in connected_regions(segment.colours[shades[window]], smallest):
            if np.count_nonzero(region) <= largest:
                regions.append(region)
        if not regions:
            return False

        # If no region overlaps, the nearest region is chosen, since a small object may move by more
        # than its own size.
        best = max(regions, key=lambda region: (overlap(region, last), -_distance(region, last)))
        segment.mask = np.zeros_like(segment.mask)
        segment.mask[window] = best
        return True


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the distance between the centres of two masks (H, W) bool, px."""
    return float(np.hypot(*(np.argwhere(first).mean(0) - np.argwhere(second).mean(0))))


def _shades(image: np.ndarray) -> np.ndarray:
    """Return the index of each pixel's colour among 4096 colours, (H, W) int."""
    red, green, blue = np.moveaxis(image.astype(np.int32) * _SHADES // 256, -1, 0)
    return np.asarray((red * _SHADES + green) * _SHADES + blue)


def _typical_colours(shades: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return which colours have a larger share inside of a mask than outside of it, (4096,)
    bool.
    """
    inside = np.bincount(shades[mask], minlength=_SHADES**3)
    outside = np.bincount(shades[~mask], minlength=_SHADES**3)
    return np.asarray(inside * outside.sum() > outside * inside.sum())
