"""What can be said about a LeRobot checkpoint beside what it says itself."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig


class LeRobotConfig(ModelConfig):
    """A folder or hub id with `config.json`, `model.safetensors` and LeRobot's two processor pipelines.

    Unset, `actions`, `execute` and `ensemble_m` are the checkpoint's own: its temporal ensemble, its `n_action_steps`,
    a queue where it looks at several observations. `dtype: auto` is the checkpoint's, too.
    """

    overrides: dict[str, Any] = Field(
        default={},
        description="laid over the checkpoint's config.json, as LeRobot's --policy.KEY=VALUE: num_inference_steps: 10",
    )
    processors: dict[str, dict[str, Any]] = Field(
        default={},
        description="laid over the settings of the checkpoint's processor steps, by their registered names: "
        "tokenizer_processor: {tokenizer_name: /models/tokenizer}",
    )
    rename_map: dict[str, str] | None = Field(
        default=None,
        description="LeRobot's --rename_map, observation key -> the policy's; unset: the one in the checkpoint. It "
        "decides how the cameras are called here where `cameras` is unset",
    )
    masked_cameras: list[str] = Field(
        default=[],
        description="cameras of the policy that this robot does not have, which the model masks; for smolvla, pi0, "
        "pi05, pi0_fast and xvla",
    )
