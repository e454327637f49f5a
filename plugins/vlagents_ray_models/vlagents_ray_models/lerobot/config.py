"""Settings of LeRobot policies, in addition to the settings in the checkpoint."""

from __future__ import annotations

import importlib.metadata
from typing import Any

from pydantic import Field

from vlagents_ray.policies.base.config import AdapterConfig, NoiseLevel
from vlagents_ray_models.attention_config import AttentionConfig


class LeRobotConfig(AttentionConfig, AdapterConfig):
    """Settings of a policy from a checkpoint of LeRobot.

    The checkpoint is a folder or a hub id with `config.json`, `model.safetensors` and LeRobot's two
    processor pipelines. The checkpoint also determines the defaults of `actions`, `execute` and
    `ensemble_m`, from its temporal ensemble and its `n_action_steps`. If the policy reads several
    observations, the default of `actions` is "queue". `dtype: auto` selects the checkpoint's type.
    """

    overrides: dict[str, Any] = Field(
        default={},
        description="overrides the checkpoint's config.json, as LeRobot's --policy.KEY=VALUE: "
        "num_inference_steps: 10",
    )
    processors: dict[str, dict[str, Any]] = Field(
        default={},
        description="overrides of the settings of the checkpoint's processor steps, by their "
        "registered names: tokenizer_processor: {tokenizer_name: /models/tokenizer}",
    )
    rename_map: dict[str, str] | None = Field(
        default=None,
        description="LeRobot's --rename_map, observation key -> the policy's; unset: the one in "
        "the checkpoint. It determines the names of the cameras if `cameras` is unset",
    )
    masked_cameras: list[str] = Field(
        default=[],
        description="cameras of the policy that this robot does not have, which the model masks; "
        "for smolvla, pi0, pi05, pi0_fast and xvla",
    )
    noise_level: NoiseLevel = 0.0
    longest_prefix: int = Field(
        default=0,
        ge=0,
        description="largest number of given rows with which a smolvla was trained to begin its "
        "chunks, as by examples/learn/prefixes.py; 0: chunks are guided",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run the code that the checkpoint names: processor steps that are not "
        "LeRobot's nor an installed plugin's, and what LeRobot takes from the hub as code (action "
        "tokenizers of pi0_fast and wall_x); write access to these then gives all rights of this "
        "process",
    )


# Supported version of LeRobot -> the name of its environment for `vlagents-ray venv create`.
REQUIREMENTS = {"0.4.4": "lerobot", "0.6.1": "lerobot06"}

# Policy type -> the reason why no version of it is served.
_REWARDS = dict.fromkeys(
    ("reward_classifier", "sarm", "robometer", "topreward"), "it returns rewards, not actions"
)

# Version of LeRobot -> policy type -> the reason why this version's policy is not served.
_NOT_SERVED = {
    "0.4.4": {
        "groot": "it is GR00T N1.5, whose statistics cannot be checked in LeRobot 0.4.4; serve it "
        "with GR00T's own code, or GR00T N1.7 with LeRobot 0.6.1 (`vlagents-ray venv create "
        "lerobot06`)"
    },
    "0.6.1": {
        "lingbot_va": "it continues from the frames and caches of the previous chunk, which it "
        "stores for one robot only"
    },
}

# Policy type -> the only version of LeRobot that supports it.
_ONLY_IN = {
    "sac": "0.4.4",
    "eo1": "0.6.1",
    "evo1": "0.6.1",
    "fastwam": "0.6.1",
    "gaussian_actor": "0.6.1",
    "lingbot_va": "0.6.1",
    "molmoact2": "0.6.1",
    "multi_task_dit": "0.6.1",
    "vla_jepa": "0.6.1",
}


def installed() -> str:
    """Return the version of LeRobot in this environment, such as "0.6.1"."""
    return importlib.metadata.version("lerobot")


def is_new() -> bool:
    """Return whether this environment has LeRobot 0.6 or newer."""
    major, minor = installed().split(".")[:2]
    return (int(major), int(minor)) >= (0, 6)


def reason_not_served(policy_type: str) -> str | None:
    """Return why this environment cannot serve a type of LeRobot's policies.

    Args:
        policy_type: The `type` in a checkpoint's config.json, such as "smolvla".

    Returns:
        The reason and the cure, for an error message; None if the type is served.
    """
    our_version = "0.6.1" if is_new() else "0.4.4"
    reason = _REWARDS.get(policy_type) or _NOT_SERVED[our_version].get(policy_type)
    if reason is not None:
        return reason

    needed_version = _ONLY_IN.get(policy_type, our_version)
    if needed_version == our_version:
        return None

    successor = ""
    if policy_type == "sac":
        successor = "; LeRobot 0.6 calls that gaussian_actor, and does not read it"
    return (
        f"LeRobot {installed()}, the one here, does not have it{successor}; "
        f"{_cure_with(needed_version)}"
    )


def _cure_with(version: str) -> str:
    """Return how to serve a checkpoint that needs this version of LeRobot, for an error
    message.
    """
    return f"LeRobot {version} reads it: `vlagents-ray venv create {REQUIREMENTS[version]}`"


def cure_with_other_version() -> str:
    """Return how to serve a checkpoint that the other version of LeRobot wrote, for an error
    message.
    """
    other = "0.4.4" if is_new() else "0.6.1"
    return f"the LeRobot here is {installed()}; if it was written by another, {_cure_with(other)}"
