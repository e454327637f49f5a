"""The wrapper that shows the policy segments on a virtual background, and the tracks of these
segments.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
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
from vlagents_ray.policies.base.checkpoint_files import METHOD, digest, weights_of
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
Colour = tuple[Channel, Channel, Channel]  # RGB, 0 to 255


class BackgroundConfig(BaseModel, extra="forbid"):
    """A colour, optionally with a grid on it, or an image, as in the policy's training."""

    colour: Colour = (0, 0, 0)
    grid: Colour | None = Field(
        default=None, description="colour of the grid's lines, one pixel wide; unset: no grid"
    )
    spacing: float = Field(
        default=0.1, gt=0, le=1, description="of the grid's lines, in shorter sides of the image"
    )
    image: Path | None = Field(
        default=None, description="a file that is stretched to each camera's size"
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for colour in (self.colour, self.grid or self.colour):
            if not all(0 <= channel <= 255 for channel in colour):
                raise ValueError(
                    f"got colour {list(colour)}, want red, green and blue from 0 to 255"
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
        """Return a new (H, W, 3) uint8 image: `image` where `mask`, (H, W) bool, is True, else
        the background.
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
            return np.asarray(
                image.convert("RGB").resize((width, height), Image.Resampling.BILINEAR)
            )
    except (OSError, UnidentifiedImageError) as error:
        raise ConfigError(
            f"background.image {str(path)!r}: cannot be read as an image ({error}); check the path"
        ) from error


Part = str | dict[str, dict[str, Any]]


class ArroConfig(BaseModel, extra="forbid"):
    """The cameras, the parts that find objects, and the treatment of missing ones."""

    cameras: list[str] | None = Field(
        default=None,
        description="the cameras that are changed; unset: those of the policy's contract, or all",
    )
    objects: list[str] | None = Field(
        default=None,
        min_length=1,
        description="phrases of the things to show; unset: those in the instruction",
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
        description="of the gripper: 'circle' or 'module:Class', or {name: settings}; null: none",
    )
    tracker: Part = Field(
        default="sam2", description="'sam2', 'iou' or 'module:Class', or {name: settings}"
    )
    background: BackgroundConfig = BackgroundConfig()
    grow: int = Field(
        default=0, ge=0, le=64, description="pixels by which segments are widened on each side"
    )
    missing: Literal["refuse", "hide"] = Field(
        default="refuse",
        description="if the first frame lacks something: refuse the episode, or begin it without, "
        "and look again "
        "as for what is lost",
    )
    keep_lost: int = Field(
        default=5,
        ge=0,
        description="frames for which a segment that is lost is shown where it was; then, and "
        "every so many frames, "
        "it is looked for as on the first frame",
    )


GRIPPER = "(gripper)"  # the label of the selector's regions; never a phrase for the detector
Segment = tuple[str, np.ndarray]  # label and mask, (H, W) bool
_SAME = 0.5  # intersection over union above which a detected object is one that is already tracked


@dataclass(slots=True)
class Track:
    """The segments of one session on one camera."""

    wanted: tuple[str, ...]  # the phrases, and GRIPPER
    labels: list[str] = field(default_factory=list)  # the label of each segment
    # (H, W) bool each, at its last visible position.
    masks: list[np.ndarray] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)  # frames since then, for each segment
    memory: Any = None  # the tracker's memory
    incomplete: int = 0  # number of frames for which a segment has been missing
    searched: bool = True  # whether this frame was searched

    @property
    def seen(self) -> list[str]:
        return [label for label, lost in zip(self.labels, self.lost, strict=True) if not lost]

    @property
    def missing(self) -> list[str]:
        """Labels of segments that are lost or were never found."""
        lost = [label for label, frames in zip(self.labels, self.lost, strict=True) if frames]
        return list(dict.fromkeys([*lost, *(one for one in self.wanted if one not in self.labels)]))

    def shown(self, shape: tuple[int, int], keep_lost: int, grow: int) -> np.ndarray:
        """Return the union of the segments, (H, W) bool; one lost for at most `keep_lost` frames
        is where it was.
        """
        together = np.zeros(shape, bool)
        for mask, lost in zip(self.masks, self.lost, strict=True):
            if lost <= keep_lost:
                together |= mask
        return grown(together, grow)

    def move(self, masks: Iterable[np.ndarray], seen: np.ndarray) -> None:
        self.masks = [
            new if is_seen else old
            for new, old, is_seen in zip(masks, self.masks, seen, strict=True)
        ]
        self.lost = [
            0 if is_seen else frames + 1 for frames, is_seen in zip(self.lost, seen, strict=True)
        ]


class Tracking:
    """The four parts together, for any number of sessions and cameras at once."""

    def __init__(self, config: ArroConfig) -> None:
        self._detector: Detector = make_part("detector", config.detector)
        self._segmenter: Segmenter = make_part("segmenter", config.segmenter)
        self._selector: Selector | None = (
            None if config.selector is None else make_part("selector", config.selector)
        )
        self._tracker: Tracker = make_part("tracker", config.tracker)
        self._keep_lost = config.keep_lost

    def load(self) -> None:
        for part in (self._detector, self._segmenter, self._selector, self._tracker):
            if part is not None:
                part.load()

    def begin(self, images: Images, phrases: Sequence[str]) -> list[Track]:
        """Find the requested objects on each image; those not found are in its track's
        `missing`.
        """
        wanted = tuple(phrases) if self._selector is None else (*phrases, GRIPPER)
        tracks = [Track(wanted) for _ in images]
        self._search(images, tracks)
        return tracks

    def follow(self, images: Images, tracks: Sequence[Track]) -> None:
        moving = [i for i, track in enumerate(tracks) if track.labels]
        moved = self._tracker.follow(
            [images[i] for i in moving], [tracks[i].memory for i in moving]
        )
        for i, (masks, seen) in zip(moving, moved, strict=True):
            tracks[i].move(masks, seen)
        for track in tracks:
            track.incomplete = track.incomplete + 1 if track.missing else 0
            track.searched = track.incomplete > 0 and track.incomplete % (self._keep_lost + 1) == 0
        due = [i for i, track in enumerate(tracks) if track.searched]
        if due:
            self._search([images[i] for i in due], [tracks[i] for i in due])

    def _search(self, images: Images, tracks: Sequence[Track]) -> None:
        """Search missing objects; a track that gains some begins again with these and the
        visible ones.
        """
        cut = self._things(
            images, [[label for label in track.missing if label != GRIPPER] for track in tracks]
        )
        grippers = self._grippers(images, [GRIPPER in track.missing for track in tracks])
        begun = []
        for i, track in enumerate(tracks):
            kept = [
                (label, track.masks[n]) for n, label in enumerate(track.labels) if not track.lost[n]
            ]
            new = [
                pair
                for pair in cut[i] + grippers[i]
                if all(overlap(pair[1], mask) < _SAME for _, mask in kept)
            ]
            if new:
                track.labels = [label for label, _ in kept + new]
                track.masks = [mask for _, mask in kept + new]
                track.lost = [0] * len(track.labels)
                begun.append(i)
        if begun:
            masks = [np.stack(tracks[i].masks) for i in begun]
            for i, memory in zip(
                begun, self._tracker.begin([images[i] for i in begun], masks), strict=True
            ):
                tracks[i].memory = memory

    def _things(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Segment]]:
        """Return the detected objects; the segmenter computes their masks if the detector does
        not.
        """
        found: list[list[Detection]] = [[] for _ in images]
        asked = [i for i, wanted in enumerate(phrases) if wanted]
        if asked:
            detected = self._detector.detect(
                [images[i] for i in asked], [phrases[i] for i in asked]
            )
            for i, things in zip(asked, detected, strict=True):
                found[i] = things
        boxed = [i for i, things in enumerate(found) if any(thing.mask is None for thing in things)]
        boxes = [np.stack([thing.box for thing in found[i] if thing.mask is None]) for i in boxed]
        made = self._segmenter.segment([images[i] for i in boxed], boxes) if boxed else []
        cut = {i: iter(masks) for i, masks in zip(boxed, made, strict=True)}
        segments = [
            [(thing.phrase, next(cut[i]) if thing.mask is None else thing.mask) for thing in things]
            for i, things in enumerate(found)
        ]
        return [[(label, mask) for label, mask in own if mask.any()] for own in segments]

    def _grippers(self, images: Images, wanted: Sequence[bool]) -> list[list[Segment]]:
        """Return the gripper's regions, on the images where it is requested and visible."""
        grippers: list[list[Segment]] = [[] for _ in images]
        asked = [i for i, is_wanted in enumerate(wanted) if is_wanted]
        if self._selector is not None and asked:
            regions = self._segmenter.propose([images[i] for i in asked])
            chosen = self._selector.select([images[i] for i in asked], regions)
            for i, masks, numbers in zip(asked, regions, chosen, strict=True):
                # copies: a view of one would keep all proposed masks in memory
                grippers[i] = [(GRIPPER, masks[number].copy()) for number in numbers]
        return grippers


# In Act.info and what `reset` returns: {camera: {"seen": labels, "missing": labels, "searched":
# bool}}.
INFO = "arro"


class Arro(Wrapper):
    """Paints over all but the gripper and the objects of the task, on the cameras of the config.

    Each session tracks its own objects; detector, segmenter and tracker get the images of all
    sessions of a batch together. `Obs.info` is not changed, so that an image in it, such as a goal,
    must already show its own background.
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
        with used_checkpoints() as parts:
            self.background.load()
            self.tracking.load()
        with used_checkpoints() as own:
            super().initialize()
        self.weights_id = with_parts(self.weights_id or weights_of(own), parts)
        stated = self.agent.contract.cameras if self.agent.contract is not None else None
        idle = sorted(set(self.config.cameras or ()) - set(stated or ())) if stated else []
        if idle:
            raise ConfigError(
                f"arro: cameras {idle} are none of the policy's, {sorted(stated or ())}; name some "
                "of those"
            )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode of both; raises `InvalidObservation` if a required object is missing."""
        return {**super().reset(obs, instruction, **kwargs), INFO: self._report()}

    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        names = self._names(obs)
        phrases = self.config.objects or ([instruction] if instruction else [])
        if not phrases:
            raise InvalidObservation(
                "instruction: got none, want one that names the things to show; or set `objects`"
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
        results: list[Obs | Exception] = list(obs)
        images: list[np.ndarray] = []
        tracks: list[Track] = []
        for i, (one, session) in enumerate(zip(obs, sessions, strict=True)):
            try:
                views = session._views(one)  # type: ignore[attr-defined]
            except VLAgentsError as error:
                results[i] = error
                continue
            images += [image for image, _ in views]
            tracks += [track for _, track in views]
        self.tracking.follow(images, tracks)
        return [
            one if isinstance(one, Exception) else session._changed(one)  # type: ignore[attr-defined]
            for one, session in zip(results, sessions, strict=True)
        ]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        acts = super().act_batch(obs, sessions)
        return [
            act if isinstance(act, Exception) else session._told(act)  # type: ignore[attr-defined]
            for act, session in zip(acts, sessions, strict=True)
        ]

    def _names(self, obs: Obs) -> list[str]:
        stated = self.agent.contract.cameras if self.agent.contract is not None else None
        names = list(self.config.cameras or stated or obs.cameras)
        for name in names:
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
        return names

    def _views(self, obs: Obs) -> list[tuple[np.ndarray, Track]]:
        """Return the images to change, with their tracks; raises before any of them is changed."""
        views = []
        for name, track in self._begun().items():
            if name not in obs.cameras:
                raise MissingCamera(name, have=obs.cameras)
            image = obs.cameras[name]
            if len(track.masks) and track.masks[0].shape != image.shape[:2]:
                raise InvalidObservation(
                    f"camera {name!r}: got {image.shape[:2]}, want {track.masks[0].shape} as at "
                    "reset; keep its size"
                )
            views.append((image, track))
        return views

    def _changed(self, obs: Obs) -> Obs:
        cameras = dict(obs.cameras)
        for name, track in self._begun().items():
            height, width = cameras[name].shape[:2]
            mask = track.shown((height, width), self.config.keep_lost, self.config.grow)
            cameras[name] = self.background.behind(cameras[name], mask)
        return replace(obs, cameras=cameras)

    def _told(self, act: Act) -> Act:
        return replace(act, info={**act.info, INFO: self._report()})

    def _report(self) -> Mapping[str, Any]:
        return {
            name: {"seen": track.seen, "missing": track.missing, "searched": track.searched}
            for name, track in self._begun().items()
        }

    def _begun(self) -> dict[str, Track]:
        if self.tracks is None:
            raise NotReset("arro: act before reset; call reset(obs, instruction) first")
        return self.tracks


def with_parts(policy: dict[str, Any] | None, parts: Sequence[Path]) -> dict[str, Any] | None:
    """Return the `Agent.weights_id` of a policy that acts with files and folders of other models
    beside its own.
    """
    if not parts:
        return policy
    own = policy or {"digest": None, "revision": None}
    both = hashlib.sha256(f"{own['digest']} {digest(parts)}".encode()).hexdigest()
    return {**own, "digest": f"{METHOD}:{both}"}
