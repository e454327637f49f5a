"""The wrapper that shows segments on a virtual background to the policy, and the tracks of these
segments.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidObservation,
    MissingCamera,
    NotReset,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base.checkpoint import used_checkpoints
from vlagents_ray.policies.base.checkpoint_files import METHOD, digest, identify_weights
from vlagents_ray.policies.wrapper import Wrapper
from vlagents_ray_arro.parts import (
    Detection,
    Detector,
    Images,
    Segmenter,
    Selector,
    Tracker,
    grown,
    make_part,
    overlap,
)

Channel = int
Colour = tuple[Channel, Channel, Channel]  # RGB values, 0 to 255


class BackgroundConfig(BaseModel, extra="forbid"):
    """The background: a colour, optionally with a grid, or an image.

    It must be the same as in the policy's training.
    """

    colour: Colour = (0, 0, 0)
    grid: Colour | None = Field(
        default=None, description="colour of the grid's lines, one pixel wide; unset: no grid"
    )
    spacing: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="distance of the grid's lines, in shorter sides of the image",
    )
    image: Path | None = Field(
        default=None, description="an image file, which is stretched to the size of each camera"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for colour in (self.colour, self.grid or self.colour):
            if not all(0 <= channel <= 255 for channel in colour):
                raise ValueError(
                    f"expected a colour as red, green and blue from 0 to 255, got {list(colour)}"
                )
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
        """Paint the background over everything outside of a mask.

        Args:
            image: (H, W, 3) uint8.
            mask: (H, W) bool.

        Returns:
            A new image, (H, W, 3) uint8.
        """
        height, width = mask.shape
        if (height, width) not in self._drawn:
            self._drawn[height, width] = self._draw(height, width)
        return np.where(mask[..., None], image, self._drawn[height, width])

    def _draw(self, height: int, width: int) -> np.ndarray:
        config = self._config
        if config.image is not None:
            return _read_image(config.image, height, width)

        background = np.full((height, width, 3), config.colour, np.uint8)
        if config.grid is not None:
            spacing = max(2, round(config.spacing * min(height, width)))  # px
            background[spacing // 2 :: spacing] = config.grid
            background[:, spacing // 2 :: spacing] = config.grid
        return background


def _read_image(path: Path, height: int, width: int) -> np.ndarray:
    """Return an image file stretched to (height, width, 3) uint8."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path.expanduser()) as image:
            rgb = image.convert("RGB")
            return np.asarray(rgb.resize((width, height), Image.Resampling.BILINEAR))
    except (OSError, UnidentifiedImageError) as error:
        raise ConfigError(
            f"background.image {str(path)!r}: cannot be read as an image ({error}); check the path"
        ) from error


Part = str | dict[str, dict[str, Any]]  # a name, or {name: settings}


class ArroConfig(BaseModel, extra="forbid"):
    """The cameras, the parts that find objects, and the treatment of missing objects."""

    cameras: list[str] | None = Field(
        default=None,
        description="the cameras that are changed; unset: those of the policy's contract, or all",
    )
    objects: list[str] | None = Field(
        default=None,
        min_length=1,
        description="phrases of the objects to show; unset: those in the instruction",
    )
    detector: Part = Field(
        default="grounding_dino",
        description="'grounding_dino', 'colour' or 'module:Class', or {name: settings}",
    )
    segmenter: Part = Field(
        default="sam2", description="'sam2', 'flat' or 'module:Class', or {name: settings}"
    )
    selector: Part | None = Field(
        default="circle",
        description="selects the gripper: 'circle' or 'module:Class', or {name: settings}; null: "
        "the gripper is not shown",
    )
    tracker: Part = Field(
        default="sam2", description="'sam2', 'iou' or 'module:Class', or {name: settings}"
    )
    background: BackgroundConfig = Field(
        default=BackgroundConfig(), description="what replaces the pixels that are not shown"
    )
    grow: int = Field(
        default=0, ge=0, le=64, description="pixels by which segments are widened on each side"
    )
    missing: Literal["refuse", "hide"] = Field(
        default="refuse",
        description="if an object is missing on the first frame: reject the episode, or begin it "
        "without the object and search for the object again as if it were lost",
    )
    keep_lost: int = Field(
        default=5,
        ge=0,
        description="number of frames for which a lost segment is shown at its last position; on "
        "the frame after them, the segment is searched for as on the first frame, and this search "
        "is repeated at the same interval",
    )


GRIPPER = "(gripper)"  # label of the selector's regions; never a phrase for the detector
Segment = tuple[str, np.ndarray]  # a segment: its label and its mask, (H, W) bool
# The intersection over union above which a detected object is regarded as already tracked.
_SAME = 0.5


@dataclass(slots=True)
class Track:
    """The segments of one session on one camera."""

    required: tuple[str, ...]  # the phrases, and GRIPPER if there is a selector
    labels: list[str] = field(default_factory=list)  # the label of each segment
    # The mask of each segment at its last visible position, (H, W) bool.
    masks: list[np.ndarray] = field(default_factory=list)
    # Number of frames since each segment was visible; 0 means visible.
    lost_frames: list[int] = field(default_factory=list)
    memory: Any = None  # the tracker's memory
    incomplete_frames: int = 0  # consecutive frames on which a segment has been missing
    searched: bool = True  # whether objects were searched for on this frame

    @property
    def visible(self) -> list[Segment]:
        """The visible segments."""
        segments = []
        for label, mask, lost in zip(self.labels, self.masks, self.lost_frames, strict=True):
            if not lost:
                segments.append((label, mask))
        return segments

    @property
    def seen(self) -> list[str]:
        """The labels of the visible segments."""
        return [label for label, _ in self.visible]

    @property
    def missing(self) -> list[str]:
        """The labels of segments that are lost or were never found."""
        missing = []
        for label, lost in zip(self.labels, self.lost_frames, strict=True):
            if lost:
                missing.append(label)
        missing += [label for label in self.required if label not in self.labels]
        return list(dict.fromkeys(missing))

    def shown(self, shape: tuple[int, int], keep_lost: int, grow: int) -> np.ndarray:
        """Return the union of the segments.

        Args:
            shape: The height and the width of the image.
            keep_lost: The number of frames for which a lost segment remains at its last position.
            grow: The number of pixels by which the union is widened on each side.

        Returns:
            The union, (H, W) bool.
        """
        union = np.zeros(shape, bool)
        for mask, lost in zip(self.masks, self.lost_frames, strict=True):
            if lost <= keep_lost:
                union |= mask
        return grown(union, grow)

    def move(self, masks: Iterable[np.ndarray], visible: np.ndarray) -> None:
        """Move the segments to their positions on the next frame.

        Args:
            masks: The mask of each segment, (H, W) bool.
            visible: Which segments are visible, (N,) bool. Other segments keep their masks.
        """
        new_masks, lost_frames = [], []
        for mask, last_mask, lost, is_visible in zip(
            masks, self.masks, self.lost_frames, visible, strict=True
        ):
            new_masks.append(mask if is_visible else last_mask)
            lost_frames.append(0 if is_visible else lost + 1)
        self.masks, self.lost_frames = new_masks, lost_frames

    def restart(self, segments: Sequence[Segment]) -> None:
        """Replace all segments with visible ones."""
        self.labels = [label for label, _ in segments]
        self.masks = [mask for _, mask in segments]
        self.lost_frames = [0] * len(segments)


class Tracking:
    """The combination of detector, segmenter, selector and tracker, for any number of sessions and
    cameras.
    """

    def __init__(self, config: ArroConfig) -> None:
        self._detector: Detector = make_part("detector", config.detector)
        self._segmenter: Segmenter = make_part("segmenter", config.segmenter)
        self._selector: Selector | None = (
            None if config.selector is None else make_part("selector", config.selector)
        )
        self._tracker: Tracker = make_part("tracker", config.tracker)
        self._keep_lost = config.keep_lost

    def load(self) -> None:
        """Load the weights of all parts; raises `ConfigError` if some are missing."""
        for part in (self._detector, self._segmenter, self._selector, self._tracker):
            if part is not None:
                part.load()

    def begin(self, images: Images, phrases: Sequence[str]) -> list[Track]:
        """Search for objects on each image.

        Args:
            images: The first images of cameras.
            phrases: The phrases of the objects.

        Returns:
            A track for each image. The track's `missing` lists the objects that were not found.
        """
        required = tuple(phrases) if self._selector is None else (*phrases, GRIPPER)
        tracks = [Track(required) for _ in images]
        self._search(images, tracks)
        return tracks

    def follow(self, images: Images, tracks: Sequence[Track]) -> None:
        """Update tracks from their next images."""
        tracked = [i for i, track in enumerate(tracks) if track.labels]
        followed = self._tracker.follow(
            [images[i] for i in tracked], [tracks[i].memory for i in tracked]
        )
        for i, (masks, visible) in zip(tracked, followed, strict=True):
            tracks[i].move(masks, visible)

        due = []
        for i, track in enumerate(tracks):
            frames = track.incomplete_frames + 1 if track.missing else 0
            track.incomplete_frames = frames
            track.searched = frames > 0 and frames % (self._keep_lost + 1) == 0
            if track.searched:
                due.append(i)
        if due:
            self._search([images[i] for i in due], [tracks[i] for i in due])

    def _search(self, images: Images, tracks: Sequence[Track]) -> None:
        """Search for missing objects.

        If objects of a track are found, the track begins again with these objects and its visible
        segments.
        """
        phrases = []
        for track in tracks:
            phrases.append([label for label in track.missing if label != GRIPPER])
        objects = self._find_objects(images, phrases)
        grippers = self._find_grippers(images, [GRIPPER in track.missing for track in tracks])

        restarted = []
        for i, track in enumerate(tracks):
            visible = track.visible
            new_segments = []
            for label, mask in objects[i] + grippers[i]:
                if all(overlap(mask, visible_mask) < _SAME for _, visible_mask in visible):
                    new_segments.append((label, mask))
            if new_segments:
                track.restart(visible + new_segments)
                restarted.append(i)
        if not restarted:
            return

        masks = [np.stack(tracks[i].masks) for i in restarted]
        memories = self._tracker.begin([images[i] for i in restarted], masks)
        for i, memory in zip(restarted, memories, strict=True):
            tracks[i].memory = memory

    def _find_objects(
        self, images: Images, phrases: Sequence[Sequence[str]]
    ) -> list[list[Segment]]:
        """Return the objects of the phrases on each image, without objects with an empty mask."""
        detections: list[list[Detection]] = [[] for _ in images]
        requested = [i for i, image_phrases in enumerate(phrases) if image_phrases]
        if requested:
            detected = self._detector.detect(
                [images[i] for i in requested], [phrases[i] for i in requested]
            )
            for i, image_detections in zip(requested, detected, strict=True):
                detections[i] = image_detections

        objects = []
        for pairs in self._with_masks(images, detections):
            segments = []
            for detection, mask in pairs:
                if mask.any():
                    segments.append((detection.phrase, mask))
            objects.append(segments)
        return objects

    def _with_masks(
        self, images: Images, detections: Sequence[Sequence[Detection]]
    ) -> list[list[tuple[Detection, np.ndarray]]]:
        """Return the detections on each image with their masks, which the segmenter computes if
        the detector does not.
        """
        boxes: dict[int, list[np.ndarray]] = {}  # detections by the index of the image
        for i, image_detections in enumerate(detections):
            for detection in image_detections:
                if detection.mask is None:
                    boxes.setdefault(i, []).append(detection.box)
        segmented: dict[int, Iterator[np.ndarray]] = {}
        if boxes:
            masks = self._segmenter.segment(
                [images[i] for i in boxes],
                [np.stack(image_boxes) for image_boxes in boxes.values()],
            )
            segmented = {i: iter(image_masks) for i, image_masks in zip(boxes, masks, strict=True)}

        with_masks = []
        for i, image_detections in enumerate(detections):
            pairs = []
            for detection in image_detections:
                mask = next(segmented[i]) if detection.mask is None else detection.mask
                pairs.append((detection, mask))
            with_masks.append(pairs)
        return with_masks

    def _find_grippers(self, images: Images, requested: Sequence[bool]) -> list[list[Segment]]:
        """Return the gripper's regions on the images where it is requested and visible."""
        grippers: list[list[Segment]] = [[] for _ in images]
        indices = [i for i, is_requested in enumerate(requested) if is_requested]
        if self._selector is None or not indices:
            return grippers

        requested_images = [images[i] for i in indices]
        regions = self._segmenter.propose(requested_images)
        selected = self._selector.select(requested_images, regions)
        for i, masks, numbers in zip(indices, regions, selected, strict=True):
            # These are copies, since a view of one mask would keep all proposed masks in memory.
            grippers[i] = [(GRIPPER, masks[number].copy()) for number in numbers]
        return grippers


# The key in `Act.info` and in the result of `reset`. Its value is {camera: {"seen": labels,
# "missing": labels, "searched": bool}}.
INFO = "arro"


class Arro(Wrapper):
    """Paints over everything except the gripper and the objects of the task, on the cameras of the
    config.

    Each session tracks its own objects. Detector, segmenter and tracker process the images of all
    sessions of a batch together. `Obs.info` is not changed, so an image in `Obs.info`, such as a
    goal, must already show the virtual background.
    """

    Config: ClassVar[type] = ArroConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "tracking", "background")

    def __init__(self, agent: Agent, config: ArroConfig) -> None:
        """Wrap a policy.

        Args:
            agent: The policy.
            config: The cameras, the parts of their images to keep, and the models that find them.
        """
        super().__init__(agent, config)
        self.tracking = Tracking(config)
        self.background = Background(config.background)
        self.tracks: dict[str, Track] | None = None

    @property
    def contract(self) -> Contract:
        """The inner agent's contract, with the cameras of the config, and an instruction that
        names the objects.
        """
        inner = self.agent.contract or Contract()
        needed = {name: CameraSpec() for name in self.config.cameras or ()}
        return replace(
            inner,
            cameras={**needed, **(inner.cameras or {})} or inner.cameras,
            instruction=inner.instruction if self.config.objects else True,
        )

    def initialize(self) -> None:
        """Load the parts and the policy.

        Raises:
            ConfigError: Weights are missing, or a configured camera is not a camera of the policy.
        """
        with used_checkpoints() as part_files:
            self.background.load()
            self.tracking.load()
        with used_checkpoints() as policy_files:
            super().initialize()
        self.weights_id = with_parts(identify_weights(self.agent, policy_files), part_files)

        policy_cameras = self._policy_cameras()
        unused = sorted(set(self.config.cameras or ()) - set(policy_cameras or ()))
        if policy_cameras and unused:
            raise ConfigError(
                f"arro: cameras {unused} are none of the policy's, {sorted(policy_cameras)}; name "
                "some of those"
            )

    def _policy_cameras(self) -> Mapping[str, CameraSpec] | None:
        """Return the cameras in the contract of the policy; None if it declares none."""
        contract = self.agent.contract
        return None if contract is None else contract.cameras

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of the wrapper and of the policy.

        Args:
            obs: The first observation.
            instruction: The task in words, which names the objects to search for unless the config
                does.
            kwargs: Arguments for the policy.

        Returns:
            The policy's information. The entry "arro" contains which objects were found.

        Raises:
            InvalidObservation: No objects are named, or an object is not found.
            MissingCamera: A camera is not in the observation.
        """
        return {**super().reset(obs, instruction, **kwargs), INFO: self._report()}

    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        """Search for the objects on the first observation, and return the observation with the
        background.
        """
        names = self._camera_names(obs)
        phrases = self.config.objects or ([instruction] if instruction else [])
        if not phrases:
            raise InvalidObservation(
                "instruction: expected a text that names the objects to show, got none; pass an "
                "instruction, or set `objects`"
            )
        tracks = self.tracking.begin([obs.cameras[name] for name in names], phrases)
        for name, track in zip(names, tracks, strict=True):
            if track.missing and self.config.missing == "refuse":
                raise InvalidObservation(
                    f"arro: camera {name!r} shows none of {track.missing}, found {track.seen}; is "
                    "it in sight? Else name it in `objects` in other words, leave the camera out "
                    "of `cameras`, or set missing: hide"
                )
        self.tracks = dict(zip(names, tracks, strict=True))
        return self._changed(obs)

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        """Track the objects of all sessions, and return the observations with the background."""
        results: list[Obs | Exception] = list(obs)
        images: list[np.ndarray] = []
        tracks: list[Track] = []
        for i, (session_obs, session) in enumerate(zip(obs, sessions, strict=True)):
            try:
                views = session._views(session_obs)  # type: ignore[attr-defined]
            except VLAgentsError as error:
                results[i] = error
                continue
            images += [image for image, _ in views]
            tracks += [track for _, track in views]
        self.tracking.follow(images, tracks)

        for i, session in enumerate(sessions):
            if not isinstance(results[i], Exception):
                results[i] = session._changed(obs[i])  # type: ignore[attr-defined]
        return results

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Compute the policy's actions, and report the objects of each session in the info of
        its action.
        """
        acts = super().act_batch(obs, sessions)
        for i, (act, session) in enumerate(zip(acts, sessions, strict=True)):
            if not isinstance(act, Exception):
                acts[i] = session._with_report(act)  # type: ignore[attr-defined]
        return acts

    def _camera_names(self, obs: Obs) -> list[str]:
        """Return the cameras to change; raises `MissingCamera` unless the observation has all of
        them.
        """
        names = list(self.config.cameras or self._policy_cameras() or obs.cameras)
        for name in names:
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
        return names

    def _views(self, obs: Obs) -> list[tuple[np.ndarray, Track]]:
        """Return the images to change with their tracks. Both are not changed yet.

        Raises:
            MissingCamera: An image is missing.
            InvalidObservation: An image does not have the size that it had at the reset.
        """
        views = []
        for name, track in self._begun().items():
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
            image = obs.cameras[name]
            if len(track.masks) and track.masks[0].shape != image.shape[:2]:
                raise InvalidObservation(
                    f"camera {name!r}: expected {track.masks[0].shape}, as at reset, got "
                    f"{image.shape[:2]}; keep its size"
                )
            views.append((image, track))
        return views

    def _changed(self, obs: Obs) -> Obs:
        """Return an observation with the background on its images."""
        cameras = dict(obs.cameras)
        for name, track in self._begun().items():
            height, width = cameras[name].shape[:2]
            mask = track.shown((height, width), self.config.keep_lost, self.config.grow)
            cameras[name] = self.background.behind(cameras[name], mask)
        return replace(obs, cameras=cameras)

    def _with_report(self, act: Act) -> Act:
        return replace(act, info={**act.info, INFO: self._report()})

    def _report(self) -> Mapping[str, Any]:
        """Return which objects are seen on each camera, for `INFO`."""
        return {
            name: {"seen": track.seen, "missing": track.missing, "searched": track.searched}
            for name, track in self._begun().items()
        }

    def _begun(self) -> dict[str, Track]:
        """Return the tracks by camera; raises `NotReset` before the first episode."""
        if self.tracks is None:
            raise NotReset("arro: act was called before reset; call reset(obs, instruction) first")
        return self.tracks


def with_parts(policy: dict[str, Any] | None, parts: Sequence[Path]) -> dict[str, Any] | None:
    """Return the `weights_id` of a policy that also uses files of other models.

    Args:
        policy: The policy's own `weights_id`.
        parts: The files and folders of the other models.

    Returns:
        The policy's `weights_id`, with one digest for all files.
    """
    if not parts:
        return policy
    weights_id = policy or {"digest": None, "revision": None}
    both = hashlib.sha256(f"{weights_id['digest']} {digest(parts)}".encode()).hexdigest()
    return {**weights_id, "digest": f"{METHOD}:{both}"}
