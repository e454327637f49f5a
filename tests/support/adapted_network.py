"""A small network whose layers LoRA adapters change, as a policy; a deployment names it `adapted_network:Small`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row, shared_frames
from vlagents_ray.policies.base.checkpoint import find_checkpoint

HORIZON, DIM, VIEWS = 3, 4, 2
LAYERS = ("see", "look", "head.0", "head.2")


class Small(ModelPolicy):
    """A network that sees two views of a state at once, as numbers and as images, and adds noise."""

    Config = ModelConfig
    adaptable = True
    trainable = network = "model"
    passes: ClassVar[list[int]] = []  # the number of rows of each

    @property
    def contract(self) -> Contract:
        return Contract(state={"joints": StateSpec(DIM)}, action=ActionSpec(dim=DIM), chunk=HORIZON)

    def load(self) -> Any:
        import torch

        find_checkpoint(self.config.checkpoint)
        torch.manual_seed(0)
        head = torch.nn.Sequential(torch.nn.Linear(8, 8), torch.nn.Tanh(), torch.nn.Linear(8, HORIZON * DIM))
        parts = {"see": torch.nn.Linear(DIM, 8), "look": torch.nn.Conv2d(3, 8, 2, stride=2, padding=1), "head": head}
        return torch.nn.ModuleDict({**parts, "attention": torch.nn.MultiheadAttention(8, 2)})

    def perceive(self, obs: Obs) -> np.ndarray:
        return obs.state["joints"].copy()

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        import torch

        self.passes.append(len(rows))
        firsts, owners = shared_frames(rows)
        states = torch.from_numpy(np.stack([rows[i].frames[-1] for i in firsts]))
        with torch.inference_mode():
            with self.adapters.rows([rows[i].adapter for i in firsts]):
                views = torch.stack([states, -states], 1).flatten(0, 1)  # two entries for each observation
                image = torch.cat([views, -views, views**2], 1).view(-1, 3, 2, 2)
                both = self.model["see"](views) + self.model["look"](image).mean((2, 3))
                seen = torch.tanh(both).unflatten(0, (len(firsts), VIEWS)).mean(1)[owners]
            noise = torch.from_numpy(np.stack([row.noise(8) for row in rows]))
            with self.adapters.rows([row.adapter for row in rows]):
                chunks = self.model["head"](seen + noise).unflatten(1, (HORIZON, DIM))
        return [Prediction(chunk, info={"rows": len(rows)}) for chunk in chunks.numpy()]


def base(tmp_path: Path) -> Path:
    folder = tmp_path / "base"
    folder.mkdir(exist_ok=True)
    (folder / "weights.bin").write_bytes(b"base")
    return folder
