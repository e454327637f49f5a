"""Settings of Diffusion Policy."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig


class DiffusionPolicyConfig(ModelConfig):
    """Settings of Diffusion Policy, beside those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="a .ckpt file, or a folder or org/name@COMMIT of the hub, with only one; `{step}` stands for "
        "checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False,
        description="these checkpoints are pickles, and loading one runs the code that its author put in: set true if "
        "you trust its origin",
    )
    source_dir: str | None = Field(
        default=None,
        description="a checkout of Diffusion Policy; unset: the installed one, or that of DIFFUSION_POLICY_SRC",
    )
    dtype: Literal["auto", "float32"] = Field(default="auto", description="float32, as its authors compute")
    actions: Literal["chunk", "queue", "ensemble"] = Field(
        default="queue",
        description="as in all models; 'queue' because the model sees the last frames, those within a chunk too, "
        "which arrive here only if each of them is sent",
    )
    state: list[str] | None = Field(
        default=None,
        description="parts that follow each other as the checkpoint's low_dim keys do; unset: parts of their names, "
        "'state' for a checkpoint without cameras",
    )
    steps: int | None = Field(default=None, ge=1, description="denoising steps; unset: those of the checkpoint")
