"""Settings of Octo."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig


class OctoConfig(ModelConfig):
    """Settings of Octo, beside those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="folder of `save_pretrained` (its newest step, or `folder/{step}`), or hub id: org/name@COMMIT",
    )
    dtype: Literal["auto", "float32"] = Field(default="auto", description="float32, as Octo computes")
    compile: Literal[True] = Field(default=True, description="JAX always compiles, once for each of `batch_sizes`")
    batch_sizes: list[int] | None = Field(
        default=None,
        description="the only numbers of rows to run, ascending; each is compiled when the model is loaded; unset: "
        "those of the deployment's `batch`",
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of Octo; unset: the installed one, or the one that OCTO_SRC names"
    )
    trust_remote_code: bool = Field(
        default=False,
        description="load a checkpoint that names other code than Octo's components, which then runs with all rights "
        "of this process, or that has transformers run code from the hub",
    )

    dataset: str | None = Field(
        default=None,
        description="dataset whose statistics scale the actions, e.g. bridge_dataset; unset: the checkpoint's only one",
    )
    normalization: Literal["normal", "bounds"] = Field(
        default="normal", description="how training scaled actions: by mean and std, or from [p01, p99] to [-1, 1]"
    )
    window: int | None = Field(
        default=None, ge=1, description="largest number of observations that the model gets; unset: as in training"
    )
    crop: bool = Field(
        default=True,
        description="show the middle 90% of the primary camera's area, the average crop of the training, as Octo's "
        "ResizeImageWrapper does",
    )
    goal: Literal["either", "language", "image"] = Field(
        default="either",
        description="what makes a task: an instruction, an image in `info['goal_image']` at reset, or either",
    )
