"""Settings of LeRobot policies, beside those in the checkpoint."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base.config import NoiseLevel


class LeRobotConfig(ModelConfig):
    """A folder or hub id with `config.json`, `model.safetensors` and LeRobot's two processor pipelines.

    The defaults of `actions`, `execute` and `ensemble_m` are the checkpoint's: its temporal ensemble, its
    `n_action_steps`, a queue if it needs several observations. So is `dtype: auto`.
    """

    overrides: dict[str, Any] = Field(
        default={},
        description="overrides the checkpoint's config.json, as LeRobot's --policy.KEY=VALUE: num_inference_steps: 10",
    )
    processors: dict[str, dict[str, Any]] = Field(
        default={},
        description="overrides of the settings of the checkpoint's processor steps, by their registered names: "
        "tokenizer_processor: {tokenizer_name: /models/tokenizer}",
    )
    rename_map: dict[str, str] | None = Field(
        default=None,
        description="LeRobot's --rename_map, observation key -> the policy's; unset: the one in the checkpoint. It "
        "determines the names of the cameras if `cameras` is unset",
    )
    masked_cameras: list[str] = Field(
        default=[],
        description="cameras of the policy that this robot does not have, which the model masks; for smolvla, pi0, "
        "pi05, pi0_fast and xvla",
    )
    noise_level: NoiseLevel = 0.0
    trust_remote_code: bool = Field(
        default=False,
        description="run the code that the checkpoint names: processor steps that are not LeRobot's nor an installed "
        "plugin's, and what LeRobot takes from the hub as code (action tokenizers of pi0_fast and wall_x); whoever can "
        "write there can do on this machine whatever this process can",
    )
