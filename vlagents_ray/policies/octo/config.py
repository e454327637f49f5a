"""Settings of Octo."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig


class OctoConfig(ModelConfig):
    """Beside what all models have: which data the actions are scaled for, and what is a task."""

    checkpoint: str = Field(
        min_length=1, description="folder of `save_pretrained` (its newest step, or `folder/{step}`), or hub id"
    )
    dtype: Literal["auto", "float32"] = Field(default="auto", description="float32, as Octo computes")
    compile: Literal[True] = Field(default=True, description="JAX always compiles, once for each of `batch_sizes`")
    batch_sizes: list[int] | None = Field(
        default=[1, 2, 4, 8, 16],
        description="the only numbers of rows to run, ascending; each is compiled when the model is loaded",
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of Octo; unset: the installed one, or the one that OCTO_SRC names"
    )

    dataset: str | None = Field(
        default=None,
        description="whose statistics scale the actions, such as bridge_dataset; unset: the checkpoint's only ones",
    )
    normalization: Literal["normal", "bounds"] = Field(
        default="normal", description="how training scaled actions: by mean and std, or from [p01, p99] to [-1, 1]"
    )
    window: int | None = Field(
        default=None, ge=1, description="observations that the model sees, at most; unset: as many as in training"
    )
    crop: bool = Field(
        default=True,
        description="show the middle 90% of the primary camera's area, the average crop of the training, as Octo's "
        "ResizeImageWrapper does",
    )
    goal: Literal["either", "language", "image"] = Field(
        default="either",
        description="what makes a task: an instruction, an image in `info['goal_image']` at reset, or whichever comes",
    )
