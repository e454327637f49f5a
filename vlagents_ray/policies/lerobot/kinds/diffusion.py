"""LeRobot's diffusion policies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.base import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.lerobot.kinds.kind import IMAGES, Kind, stacked, vectors
from vlagents_ray.registry import require

_TOKENS = ("observation.language.tokens", "observation.language.attention_mask")


class Diffusion(Kind):
    """Diffusion policies, with noise for the first sample and, with DDPM, for every denoising step."""

    batched = True

    def __init__(self, policy: Any, compilation: Compilation) -> None:
        super().__init__(policy, compilation)
        unet = policy.diffusion.unet
        self._denoise, self._encode = (
            compilation.core("denoise", unet.forward),
            compilation.core("vision encoder", self._condition),
        )
        unet.forward = self._forward

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.sampling_rng import generator_of

        torch, model = require("torch"), self.policy.diffusion
        noise = np.stack([row.noise(self.config.horizon, self.config.action_feature.shape[0]) for row in rows])
        actions = model.conditional_sample(
            len(rows),
            global_cond=self._encode(*stacked(batch, self.config, len(rows)).values()),
            generator=[generator_of(row.rng) for row in rows],
            noise=torch.from_numpy(noise).to(self.config.device),
        )
        return actions[:, self.steps - 1 :]

    def _forward(self, sample: Any, times: Any, global_cond: Any) -> Any:
        return self._denoise(sample, times, global_cond)

    def _condition(self, *inputs: Any) -> Any:
        names = [*vectors(self.config), *([IMAGES] if self.config.image_features else [])]
        return self.policy.diffusion._prepare_global_conditioning(dict(zip(names, inputs, strict=True)))


class MultiTaskDit(Kind):
    """The multi-task diffusion transformer of LeRobot 0.6, by diffusion or flow matching, with an instruction."""

    batched = True

    @property
    def horizon(self) -> int:
        return int(self.config.horizon - self.steps + 1)

    def draw(self, batch: dict[str, Any], rows: Sequence[Row], leftovers: Sequence[Any]) -> Any:
        from vlagents_ray.policies.sampling_rng import RowDraws

        seen = stacked(batch, self.config, len(rows))
        for name in _TOKENS:
            seen[name] = batch[name].unflatten(0, (len(rows), -1))[:, -1]  # the same for each step of a history
        condition = self.policy.observation_encoder.encode(seen)
        with RowDraws([row.rng for row in rows]):
            actions = self.policy.objective.conditional_sample(self.policy.noise_predictor, len(rows), condition)
        return actions[:, self.steps - 1 :]
