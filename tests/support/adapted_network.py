"""A policy with a small network whose layers a LoRA adapter changes. Functions below write adapters
with random values, in PEFT's format, and merge them into a network for comparison.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.policies.base import AdapterConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.weights.safetensors import header_of, parts_of

HORIZON, DIM = 3, 4
LAYERS = ("see", "look", "head.0", "head.2")


class Small(ModelPolicy):
    """A network that processes a state, as numbers and as an image, and adds noise."""

    Config = AdapterConfig
    trainable = network = "model"

    @property
    def contract(self) -> Contract:
        return Contract(state={"joints": StateSpec(DIM)}, action=ActionSpec(dim=DIM), chunk=HORIZON)

    def load(self) -> Any:
        import torch

        find_checkpoint(self.config.checkpoint)
        torch.manual_seed(0)
        head = torch.nn.Sequential(
            torch.nn.Linear(8, 8), torch.nn.Tanh(), torch.nn.Linear(8, HORIZON * DIM)
        )
        parts = {
            "see": torch.nn.Linear(DIM, 8),
            "look": torch.nn.Conv2d(3, 8, 2, stride=2, padding=1),
            "head": head,
        }
        return torch.nn.ModuleDict({**parts, "attention": torch.nn.MultiheadAttention(8, 2)})

    def perceive(self, obs: Obs) -> np.ndarray:
        return obs.state["joints"].copy()

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        import torch

        states = torch.from_numpy(np.stack([row.frames[-1] for row in rows]))
        noise = torch.from_numpy(np.stack([row.noise(8) for row in rows]))
        with torch.inference_mode():
            image = torch.cat([states, -states, states**2], 1).view(-1, 3, 2, 2)
            both = self.model["see"](states) + self.model["look"](image).mean((2, 3))
            chunks = self.model["head"](torch.tanh(both) + noise).unflatten(1, (HORIZON, DIM))
        return [Prediction(chunk) for chunk in chunks.numpy()]


def base(tmp_path: Path) -> Path:
    folder = tmp_path / "base"
    folder.mkdir(exist_ok=True)
    (folder / "weights.bin").write_bytes(b"base")
    return folder


def pairs(network: Any, layers: Sequence[str], rank: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Return random LoRA matrices A and B for these layers of a torch module, named as in PEFT.
    They change results about as much as the layers themselves.
    """
    rng, modules, found = np.random.default_rng(seed), dict(network.named_modules()), {}
    for layer in layers:
        # A convolution also has the dimensions of its kernel.
        outputs, *inputs = modules[layer].weight.shape
        ups = (outputs, rank, *(1 for _ in inputs[1:]))
        for name, shape, fan in (("A", (rank, *inputs), np.prod(inputs)), ("B", ups, rank)):
            values = (rng.standard_normal(shape) / np.sqrt(fan)).astype(np.float32)
            found[f"base_model.model.{layer}.lora_{name}.weight"] = values
    return found


def save(folder: Path, values: Mapping[str, np.ndarray], **config: Any) -> Path:
    """Write an adapter to `folder`, with lora_alpha 2 r unless `config` overrides it; return the
    folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rank = len(next(value for name, value in values.items() if ".lora_A." in name))
    usual = {
        "peft_type": "LORA",
        "r": rank,
        "lora_alpha": 2 * rank,
        "target_modules": ["any"],
        "bias": "none",
    }
    unset = {
        "base_model_name_or_path": None,
        "use_dora": False,
        "modules_to_save": None,
        "init_lora_weights": True,
    }
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
