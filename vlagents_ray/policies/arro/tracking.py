"""The tracks of objects on the cameras: found on the first frame, then tracked, and searched again when lost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.background import BackgroundConfig
from vlagents_ray.policies.arro.parts import (
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

Part = str | dict[str, dict[str, Any]]


class ArroConfig(BaseModel, extra="forbid"):
    """The cameras, the parts that find objects, and the treatment of missing ones."""

    cameras: list[str] | None = Field(
        default=None, description="the cameras that are changed; unset: those of the policy's contract, or all"
    )
    objects: list[str] | None = Field(
        default=None, min_length=1, description="phrases of the things to show; unset: those in the instruction"
    )
    detector: Part = Field(
        default="grounding_dino", description="'grounding_dino', 'colour' or 'module:Class', or {name: settings}"
    )
    segmenter: Part = Field(default="sam2", description="'sam2', 'flat' or 'module:Class', or {name: settings}")
    selector: Part | None = Field(
        default="circle", description="of the gripper: 'circle' or 'module:Class', or {name: settings}; null: none"
    )
    tracker: Part = Field(default="sam2", description="'sam2', 'iou' or 'module:Class', or {name: settings}")
    background: BackgroundConfig = BackgroundConfig()
    grow: int = Field(default=0, ge=0, le=64, description="pixels by which segments are widened on each side")
    missing: Literal["refuse", "hide"] = Field(
        default="refuse",
        description="if the first frame lacks something: refuse the episode, or begin it without, and look again "
        "as for what is lost",
    )
    keep_lost: int = Field(
        default=5,
        ge=0,
        description="frames for which a segment that is lost is shown where it was; then, and every so many frames, "
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
    masks: list[np.ndarray] = field(default_factory=list)  # (H, W) bool each, at its last visible position
    lost: list[int] = field(default_factory=list)  # frames since then, for each segment
    memory: Any = None  # the tracker's memory
    incomplete: int = 0  # number of frames for which a segment has been missing
    searched: bool = True  # whether this frame was searched

    @property
    def seen(self) -> list[str]:
        """Labels of the visible segments."""
        return [label for label, lost in zip(self.labels, self.lost, strict=True) if not lost]

    @property
    def missing(self) -> list[str]:
        """Labels of segments that are lost or were never found."""
        lost = [label for label, frames in zip(self.labels, self.lost, strict=True) if frames]
        return list(dict.fromkeys([*lost, *(one for one in self.wanted if one not in self.labels)]))

    def shown(self, shape: tuple[int, int], keep_lost: int, grow: int) -> np.ndarray:
        """Return the union of the segments, (H, W) bool.

        A segment lost for at most `keep_lost` frames is at its last position.
        """
        together = np.zeros(shape, bool)
        for mask, lost in zip(self.masks, self.lost, strict=True):
            if lost <= keep_lost:
                together |= mask
        return grown(together, grow)

    def move(self, masks: Iterable[np.ndarray], seen: np.ndarray) -> None:
        """Take over the tracker's masks."""
        self.masks = [new if is_seen else old for new, old, is_seen in zip(masks, self.masks, seen, strict=True)]
        self.lost = [0 if is_seen else frames + 1 for frames, is_seen in zip(self.lost, seen, strict=True)]


class Tracking:
    """The four parts together, for any number of sessions and cameras at once."""

    def __init__(self, config: ArroConfig) -> None:
        self._detector: Detector = make_part("detector", config.detector)
        self._segmenter: Segmenter = make_part("segmenter", config.segmenter)
        self._selector: Selector | None = None if config.selector is None else make_part("selector", config.selector)
        self._tracker: Tracker = make_part("tracker", config.tracker)
        self._keep_lost = config.keep_lost

    def load(self) -> None:
        """Read the weights of all parts."""
        for part in (self._detector, self._segmenter, self._selector, self._tracker):
            if part is not None:
                part.load()

    def begin(self, images: Images, phrases: Sequence[str]) -> list[Track]:
        """Find the requested objects on each image; those not found are in its track's `missing`."""
        wanted = tuple(phrases) if self._selector is None else (*phrases, GRIPPER)
        tracks = [Track(wanted) for _ in images]
        self._search(images, tracks)
        return tracks

    def follow(self, images: Images, tracks: Sequence[Track]) -> None:
        """Continue each track on its next image."""
        moving = [i for i, track in enumerate(tracks) if track.labels]
        moved = self._tracker.follow([images[i] for i in moving], [tracks[i].memory for i in moving])
        for i, (masks, seen) in zip(moving, moved, strict=True):
            tracks[i].move(masks, seen)
        for track in tracks:
            track.incomplete = track.incomplete + 1 if track.missing else 0
            track.searched = track.incomplete > 0 and track.incomplete % (self._keep_lost + 1) == 0
        due = [i for i, track in enumerate(tracks) if track.searched]
        if due:
            self._search([images[i] for i in due], [tracks[i] for i in due])

    def _search(self, images: Images, tracks: Sequence[Track]) -> None:
        """Search missing objects; a track that gains some begins again with these and the visible ones."""
        cut = self._things(images, [[label for label in track.missing if label != GRIPPER] for track in tracks])
        grippers = self._grippers(images, [GRIPPER in track.missing for track in tracks])
        begun = []
        for i, track in enumerate(tracks):
            kept = [(label, track.masks[n]) for n, label in enumerate(track.labels) if not track.lost[n]]
            new = [pair for pair in cut[i] + grippers[i] if all(overlap(pair[1], mask) < _SAME for _, mask in kept)]
            if new:
                track.labels = [label for label, _ in kept + new]
                track.masks = [mask for _, mask in kept + new]
                track.lost = [0] * len(track.labels)
                begun.append(i)
        if begun:
            masks = [np.stack(tracks[i].masks) for i in begun]
            for i, memory in zip(begun, self._tracker.begin([images[i] for i in begun], masks), strict=True):
                tracks[i].memory = memory

    def _things(self, images: Images, phrases: Sequence[Sequence[str]]) -> list[list[Segment]]:
        """Return the detected objects; the segmenter computes their masks if the detector does not."""
        found: list[list[Detection]] = [[] for _ in images]
        asked = [i for i, wanted in enumerate(phrases) if wanted]
        if asked:
            detected = self._detector.detect([images[i] for i in asked], [phrases[i] for i in asked])
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
