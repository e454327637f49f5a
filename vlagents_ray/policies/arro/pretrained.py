"""Loading the models of ARRO's learned parts."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.policies.arro.parts import Images
from vlagents_ray.policies.base.accelerator import ensure_torchvision, torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.config import DType
from vlagents_ray.policies.base.pretrained import from_pretrained
from vlagents_ray.registry import require


class PretrainedConfig(BaseModel, extra="forbid"):
    """Which weights, and where they run."""

    checkpoint: str = Field(min_length=1, description="a folder as transformers saves it, or a hub id")
    device: str = Field(default="auto", description="'auto' (an accelerator if there is one), 'cpu', 'cuda', 'cuda:1'")
    dtype: DType = Field(default="float32", description="of the weights")


def load_pretrained(model: str, processor: str, config: PretrainedConfig) -> tuple[Any, Any]:
    """A model and a processor by the names of their classes in transformers; `ConfigError` unless all is there."""
    ensure_torchvision()
    transformers = require("transformers")
    path = find_checkpoint(config.checkpoint, needs=("config.json", "*.safetensors", "*processor_config.json"))
    device = torch_device(config.device)
    loaded = from_pretrained(getattr(transformers, model), path, dtype=torch_dtype(config.dtype, device))
    return loaded.to(device).eval(), getattr(transformers, processor).from_pretrained(path)


def writable(images: Images) -> list[np.ndarray]:
    """Copies: a server's images are read-only, which torch warns of."""
    return [image.copy() for image in images]
