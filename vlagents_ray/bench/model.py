"""A policy as large as a real one, with random weights: for served against bare throughput.

A transformer over the patches of two 224x224 cameras and a learned query for each row of the action chunk. What it
returns means nothing; what a forward pass costs is that of a network of its size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.registry import require

IMAGE = 224  # pixels
CAMERAS = ("camera_0", "camera_1")
_CHANNELS = 3


@dataclass(frozen=True, slots=True)
class Size:
    """The size of a transformer."""

    layers: int
    width: int
    heads: int
    patch: int  # pixels; one token for each patch of each camera


# pi0 has 3.3 billion parameters (arXiv 2410.24164); OpenVLA 7 billion, with Llama 2's width (arXiv 2406.09246).
SIZES: Mapping[str, Size] = {
    "tiny": Size(layers=2, width=64, heads=2, patch=56),
    "pi0": Size(layers=29, width=3072, heads=24, patch=14),
    "openvla": Size(layers=34, width=4096, heads=32, patch=14),
}


class SizedConfig(BaseModel, extra="forbid"):
    """The size of the network, and where it runs."""

    size: Literal["tiny", "pi0", "openvla"] = "tiny"
    device: str = Field(default="cpu", description="cpu, cuda, cuda:1, …")
    dtype: Literal["float32", "bfloat16", "float16"] | None = Field(
        default=None, description="default: bfloat16, float32 for tiny"
    )
    chunk: int = Field(default=8, ge=1, description="rows of the action chunk")
    action_dim: int = Field(default=7, ge=1)
    threads: int = Field(default=1, ge=1, description="of torch, on the CPU")


class SizedPolicy(Agent):
    """Returns chunks of meaningless actions, (chunk, action_dim), at the cost of a network of that size."""

    Config: ClassVar[type] = SizedConfig
    shared: ClassVar[tuple[str, ...]] = ("config", "model")

    def __init__(self, config: SizedConfig | None = None) -> None:
        self.config = config or SizedConfig()
        self.model: Any = None

    @property
    def contract(self) -> Contract:
        cameras = dict.fromkeys(CAMERAS, CameraSpec(IMAGE, IMAGE))
        return Contract(cameras=cameras, action=ActionSpec(dim=self.config.action_dim), chunk=self.config.chunk)

    def initialize(self) -> None:
        """Make the network, on its device. Raises `MissingDependency` without torch."""
        torch = require("torch")
        if torch.device(self.config.device).type == "cpu":
            torch.set_num_threads(self.config.threads)
        self.model = build(self.config, self.config.device)

    def act(self, obs: Obs) -> Act:
        """Run a batch of one."""
        return self.act_batch([obs], [self])[0]

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act]:  # type: ignore[override]
        """Run one forward pass: pixels to the device, actions back."""
        torch = require("torch")
        pixels = np.stack([np.stack([one.cameras[name] for name in CAMERAS]) for one in obs])
        with torch.inference_mode():
            actions = forward(self.model, torch.from_numpy(pixels).to(self.config.device), self.config)
            chunks = actions.float().cpu().numpy()
        return [Act(chunk) for chunk in chunks]


def build(config: SizedConfig, device: str) -> Any:
    """Make the network, with random weights. "meta" as the device allocates nothing."""
    torch = require("torch")
    size = SIZES[config.size]
    tokens = len(CAMERAS) * (IMAGE // size.patch) ** 2 + config.chunk
    factory = {"device": device, "dtype": _dtype(config)}
    layer = torch.nn.TransformerEncoderLayer(
        size.width, size.heads, 4 * size.width, 0.0, "gelu", batch_first=True, norm_first=True, **factory
    )
    model = torch.nn.ModuleDict(
        {
            "patches": torch.nn.Linear(_CHANNELS * size.patch**2, size.width, **factory),
            "layers": torch.nn.TransformerEncoder(layer, size.layers, enable_nested_tensor=False),
            "head": torch.nn.Linear(size.width, config.action_dim, **factory),
            "learned": torch.nn.ParameterDict(
                {
                    "positions": torch.nn.Parameter(torch.randn(tokens, size.width, **factory) / 50),
                    "queries": torch.nn.Parameter(torch.randn(config.chunk, size.width, **factory) / 50),
                }
            ),
        }
    )
    return model.eval()


def forward(model: Any, pixels: Any, config: SizedConfig) -> Any:
    """Compute actions (B, chunk, D) from pixels (B, cameras, H, W, 3) uint8, both on the device of the model."""
    torch = require("torch")
    batch, patch = len(pixels), SIZES[config.size].patch
    rows = IMAGE // patch
    cut = pixels.view(batch, -1, rows, patch, rows, patch, _CHANNELS).permute(0, 1, 2, 4, 3, 5, 6)
    patches = cut.reshape(batch, -1, _CHANNELS * patch**2).to(_dtype(config)) / 127.5 - 1
    queries = model["learned"]["queries"].expand(batch, -1, -1)
    tokens = torch.cat([model["patches"](patches), queries], dim=1) + model["learned"]["positions"]
    return model["head"](model["layers"](tokens)[:, -config.chunk :])


def _dtype(config: SizedConfig) -> Any:
    return getattr(require("torch"), config.dtype or ("float32" if config.size == "tiny" else "bfloat16"))
