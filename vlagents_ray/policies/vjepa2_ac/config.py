"""Settings of V-JEPA 2-AC; the planner's defaults are those of upstream's `WorldModel`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.policies.base.config import ModelConfig


class VJepa2AcConfig(ModelConfig):
    """Settings of V-JEPA 2-AC, beside those of all models: its checkpoint, and the search for plans."""

    deterministic: Literal[False] = Field(default=False, description="not for this family")
    encoder: str | None = Field(
        default=None,
        description="folder or hub id (org/name@COMMIT) of a `VJEPA2Model` instead of the encoder in the checkpoint",
    )
    source_dir: str | None = Field(
        default=None,
        description="checkout of vjepa2, for the predictor's code; unset: that of VJEPA2_SRC, or installed",
    )
    encoder_heads: int | None = Field(
        default=None, ge=1, description="attention heads of the checkpoint's encoder; unset: those of ViT-L, -H or -g"
    )
    predictor_heads: int = Field(default=16, ge=1, description="attention heads of the predictor")
    image_size: int = Field(default=256, ge=16, description="pixels of a side, as the model was trained")
    normalize: bool = Field(default=True, description="normalise features, as the model was trained")

    execute: int | None = Field(default=1, ge=1, description="steps of a plan that are executed; in the paper one")
    rollout: int = Field(default=2, ge=1, description="steps of a plan")
    samples: int = Field(default=400, ge=2, description="plans sampled in an iteration")
    topk: int = Field(default=10, ge=2, description="number of best plans that determine the next distribution")
    iterations: int = Field(default=10, ge=1)
    momentum_mean: float = Field(default=0.15, ge=0, lt=1, description="share of the last iteration's mean position")
    momentum_std: float = Field(default=0.15, ge=0, lt=1)
    momentum_mean_gripper: float = Field(default=0.15, ge=0, lt=1)
    momentum_std_gripper: float = Field(default=0.15, ge=0, lt=1)
    maxnorm: float = Field(default=0.05, gt=0, description="largest step along each axis, m")
    close_gripper: int | None = Field(default=None, ge=0, description="step of a plan from which on the gripper closes")
    pass_size: int = Field(default=400, ge=1, description="largest number of plans in a forward pass of the predictor")

    @property
    def plans_a_pass(self) -> int:
        """The largest number of plans in a forward pass of the predictor; compiled, every full pass has as many."""
        return min(self.samples, self.pass_size) if self.compile else self.pass_size

    @model_validator(mode="after")
    def _chosen_from_more(self) -> Self:
        if self.topk > self.samples:
            raise ValueError(f"topk {self.topk} is over samples {self.samples}; want it to be a small part of them")
        return self
