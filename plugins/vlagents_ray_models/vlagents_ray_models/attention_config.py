"""The setting that selects the attention kernel of the flow's steps, for π0 and π0.5 of
transformers, openpi and LeRobot.
"""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.compilation import uses_torch_compile
from vlagents_ray_models.gemma_layers import Attention


class AttentionConfig(ModelConfig):
    """Settings of a family that runs `GemmaLayers`, in addition to the settings of all models."""

    attention: Attention = Field(
        default="sdpa",
        description="attention of the flow's steps of π0 and π0.5 in PyTorch: torch's "
        "scaled_dot_product_attention, or flex_attention, which torch.compile turns into a "
        "kernel: it needs `compile` true, max or require",
    )

    @model_validator(mode="after")
    def _flex_attention_is_compiled(self) -> Self:
        if self.attention == "flex" and not uses_torch_compile(self.compile):
            raise ValueError(
                f"attention flex: expected compile true, max or require, got {self.compile!r}; "
                "set compile: true, or leave attention out"
            )
        return self
