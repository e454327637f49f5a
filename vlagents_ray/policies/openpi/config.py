"""Settings of openpi's policies."""

from __future__ import annotations

from pydantic import Field

from vlagents_ray.policies.base import ModelConfig
from vlagents_ray.policies.base.config import NoiseLevel
from vlagents_ray.policies.openpi.robots import Layout


class OpenPiConfig(ModelConfig):
    """Settings of openpi's policies, beside those of all models."""

    config: str = Field(
        min_length=1, description="the training config: one of openpi's names, such as pi05_libero, or 'module:NAME'"
    )
    checkpoint: str = Field(
        min_length=1, description="openpi's folder of a step, with params/ or model.safetensors, and assets/; or gs://…"
    )
    source_dir: str | None = Field(
        default=None, description="a checkout of openpi; unset: the variable OPENPI_SRC, or what is installed"
    )
    cameras: dict[str, str] | None = Field(
        default=None,
        description="openpi's keys of the images -> our cameras, a dot going one level down: images.cam_high; unset: "
        "those of the config's robot",
    )
    state: dict[str, dict[str, int]] | None = Field(  # type: ignore[assignment]  # openpi has several vectors, by key
        default=None,
        description="openpi's keys of the state -> the parts of ours that make up each, and how many numbers each has; "
        "'gripper' stands for `Obs.gripper`, 'gripper_closed' for 1 minus that; unset: those of the config's robot",
    )
    layout: Layout | None = Field(default=None, description="layout of the images for the transforms: hwc or chw")
    steps: int | None = Field(default=None, ge=1, description="steps of the flow (pi0, pi0.5); unset: openpi's, 10")
    max_decoding_steps: int = Field(default=256, ge=1, description="largest number of tokens of a chunk (pi0-FAST)")
    guidance: float = Field(default=5.0, gt=0, description="real-time chunking: largest weight of the old plan")
    noise_level: NoiseLevel = 0.0
    batch_sizes: list[int] | None = Field(
        default=None,
        description="the only numbers of rows to run; unset: for JAX or with `compile` those of the "
        "deployment's `batch`, else any",
    )
