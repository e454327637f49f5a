"""Settings of the ARRO wrapper; unknown keys are errors."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.background import BackgroundConfig

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
