"""Settings of LeRobot policies, in addition to those in the checkpoint."""

from __future__ import annotations

import importlib.metadata
from typing import Any

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base.config import NoiseLevel


class LeRobotConfig(ModelConfig):
    """A folder or hub id with `config.json`, `model.safetensors` and LeRobot's two processor
    pipelines.

    The defaults of `actions`, `execute` and `ensemble_m` come from the checkpoint: its temporal
    ensemble, its `n_action_steps`, or a queue if it needs several observations. `dtype: auto` also
    selects the checkpoint's type.
    """

    overrides: dict[str, Any] = Field(
        default={},
        description="overrides the checkpoint's config.json, as LeRobot's --policy.KEY=VALUE: "
        "num_inference_steps: 10",
    )
    processors: dict[str, dict[str, Any]] = Field(
        default={},
        description="overrides of the settings of the checkpoint's processor steps, by their "
        "registered names: "
        "tokenizer_processor: {tokenizer_name: /models/tokenizer}",
    )
    rename_map: dict[str, str] | None = Field(
        default=None,
        description="LeRobot's --rename_map, observation key -> the policy's; unset: the one in "
        "the checkpoint. It "
        "determines the names of the cameras if `cameras` is unset",
    )
    masked_cameras: list[str] = Field(
        default=[],
        description="cameras of the policy that this robot does not have, which the model masks; "
        "for smolvla, pi0, "
        "pi05, pi0_fast and xvla",
    )
    noise_level: NoiseLevel = 0.0
    trust_remote_code: bool = Field(
        default=False,
        description="run the code that the checkpoint names: processor steps that are not "
        "LeRobot's nor an installed "
        "plugin's, and what LeRobot takes from the hub as code (action tokenizers of pi0_fast and "
        "wall_x); write "
        "access to these then gives all rights of this process",
    )


REQUIREMENTS = {"0.4.4": "lerobot", "0.6.1": "lerobot06"}
_REWARDS = dict.fromkeys(
    ("reward_classifier", "sarm", "robometer", "topreward"), "it returns rewards, not actions"
)
_REFUSED = {
    "0.4.4": {
        "groot": "it is GR00T N1.5, whose statistics cannot be checked in LeRobot 0.4.4; serve it "
        "with GR00T's own "
        "code, or GR00T N1.7 with LeRobot 0.6.1 (`vlagents-ray env make lerobot06`)"
    },
    "0.6.1": {
        "lingbot_va": (
            "it goes on from the frames and caches of the chunk before, which it keeps "
            "for one robot"
        )
    },
}
_ONLY_IN = {
    "sac": "0.4.4",
    **dict.fromkeys(
        (
            "eo1",
            "evo1",
            "fastwam",
            "gaussian_actor",
            "lingbot_va",
            "molmoact2",
            "multi_task_dit",
            "vla_jepa",
        ),
        "0.6.1",
    ),
}


def installed() -> str:
    """Return the version of the LeRobot of this environment, "0.6.1"."""
    return importlib.metadata.version("lerobot")


def is_new() -> bool:
    """Return whether this environment has LeRobot 0.6 or newer."""
    return tuple(int(part) for part in installed().split(".")[:2]) >= (0, 6)


def refusal(name: str) -> str | None:
    """Return why LeRobot's policies of that type cannot be served in this environment; None if
    they can.
    """
    ours = "0.6.1" if is_new() else "0.4.4"
    if reason := _REWARDS.get(name) or _REFUSED[ours].get(name):
        return reason
    if (theirs := _ONLY_IN.get(name, ours)) == ours:
        return None
    other = "; LeRobot 0.6 calls that gaussian_actor, and does not read it" if name == "sac" else ""
    return f"LeRobot {installed()}, the one here, does not have it{other}; {reads(theirs)}"


def reads(version: str) -> str:
    """Return the cure for a checkpoint of that version of LeRobot."""
    return f"LeRobot {version} reads it: `vlagents-ray env make {REQUIREMENTS[version]}`"


def other_version() -> str:
    """Return the cure for a checkpoint of the other version of LeRobot."""
    other = "0.4.4" if is_new() else "0.6.1"
    return f"the LeRobot here is {installed()}; if it was written by another, {reads(other)}"
