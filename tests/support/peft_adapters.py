"""LoRA adapters as PEFT saves them, with random values, and the same merged into a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.weights.safetensors import header_of, parts_of


def pairs(network: Any, layers: Sequence[str], rank: int, seed: int = 0) -> dict[str, np.ndarray]:
    """A and B of these layers of a torch module, by PEFT's names; they change results by as much as the layers do."""
    rng, modules, found = np.random.default_rng(seed), dict(network.named_modules()), {}
    for layer in layers:
        outputs, *inputs = modules[layer].weight.shape  # of a convolution: with the kernel
        ups = (outputs, rank, *(1 for _ in inputs[1:]))
        for name, shape, fan in (("A", (rank, *inputs), np.prod(inputs)), ("B", ups, rank)):
            values = (rng.standard_normal(shape) / np.sqrt(fan)).astype(np.float32)
            found[f"base_model.model.{layer}.lora_{name}.weight"] = values
    return found


def save(folder: Path, values: Mapping[str, np.ndarray], **config: Any) -> Path:
    """An adapter of that folder, with lora_alpha 2 r unless the config says something else."""
    folder.mkdir(parents=True, exist_ok=True)
    rank = len(next(value for name, value in values.items() if ".lora_A." in name))
    usual = {"peft_type": "LORA", "r": rank, "lora_alpha": 2 * rank, "target_modules": ["any"], "bias": "none"}
    unset = {"base_model_name_or_path": None, "use_dora": False, "modules_to_save": None, "init_lora_weights": True}
    (folder / "adapter_config.json").write_text(json.dumps({**usual, **unset, **config}))
    data = header_of(values) + b"".join(parts_of(values))
    (folder / "adapter_model.safetensors").write_bytes(data)
    return folder


def merge(network: Any, values: Mapping[str, np.ndarray], scale: float = 2.0) -> None:
    """Add scale * B A to the weights of the layers, in place."""
    import torch

    modules = dict(network.named_modules())
    with torch.no_grad():
        for name, down in values.items():
            if ".lora_A." in name:
                layer = name.removeprefix("base_model.model.").removesuffix(".lora_A.weight")
                up, weight = values[name.replace(".lora_A.", ".lora_B.")], modules[layer].weight
                change = up.reshape(len(up), -1).astype(np.float64) @ down.reshape(len(down), -1)
                weight += torch.from_numpy(scale * change).to(weight).view(weight.shape)
