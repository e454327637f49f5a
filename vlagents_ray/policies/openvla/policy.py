"""OpenVLA: decodes the next action from an image and an instruction, token by token.

Upstream's `predict_action` takes one prompt and calls `generate`. Here prompts of different lengths are padded on the
left, with masks and positions that give each the same result as alone, and share every forward pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.base.model_inputs import camera_images, camera_specs, choose_cameras
from vlagents_ray.policies.openvla import preprocessing
from vlagents_ray.policies.openvla.base import OFFERED, DecodedChunk, PreparedRow, PrismaticPolicy
from vlagents_ray.policies.openvla.prismatic import Prismatic, PrismaticConfig, load_prismatic
from vlagents_ray.registry import require

_IMAGE = "image"  # the model's only camera


class OpenVLAConfig(PrismaticConfig):
    """Settings of OpenVLA."""

    center_crop: bool = Field(
        default=False,
        description="for checkpoints trained with random crops, such as LIBERO's: pictures go through JPEG and Lanczos "
        "to 224 px, and the middle nine tenths of them to the model; else the checkpoint's own resizing is all",
    )


class OpenVLA(PrismaticPolicy):
    """The policy, which returns one action for each `act`."""

    Config = OpenVLAConfig
    config: OpenVLAConfig
    model: Prismatic

    def __init__(self, config: OpenVLAConfig) -> None:
        super().__init__(config)
        self._cameras = choose_cameras(config.cameras, {_IMAGE: "front"}, [_IMAGE])

    @property
    def contract(self) -> Contract:
        """One camera and an instruction; the actions of the checkpoint's datasets."""
        return Contract(
            cameras=camera_specs(self._cameras),
            state={},
            instruction=True,
            action=self._action(),
            chunk=self.chunk(1),
            history=1,
            behaviour=self.offered(OFFERED),
        )

    def load(self) -> Prismatic:
        """Read the checkpoint."""
        return load_prismatic(self.config)

    def perceive(self, obs: Obs) -> Any:
        """Return the image as the input of the backbones, (C, S, S) float32."""
        image = camera_images(obs, self._cameras)[_IMAGE]
        if self.config.center_crop:
            image = preprocessing.middle(preprocessing.resized(image))
        return self.model.pixels(image)

    @property
    def _checkpoint(self) -> Prismatic | None:
        return self.model

    def _model_input(self, row: Row, key: str) -> tuple[Any, list[int]]:
        return row.frames[-1], self.model.tokens(row.instruction)

    def _compute(self, prepared: Sequence[PreparedRow]) -> list[DecodedChunk]:
        """Decode all answers: a session's own greedily unless something is wanted of it, samples at temperature 1."""
        firsts, owners = shared_frames([entry.row for entry in prepared])
        draws = np.full((len(prepared), max(entry.scale.dim for entry in prepared)), np.nan)
        for numbers, entry in zip(draws, prepared, strict=True):
            if entry.row.sample:
                numbers[: entry.scale.dim] = entry.row.rng.random(entry.scale.dim)
        tokens, logits = decode(self.model, [prepared[i].model_input for i in firsts], owners, draws)
        return self._decoded(self.model.bins, prepared, tokens[:, None], logits[:, None])


def decode(
    model: Prismatic, prompts: Sequence[tuple[Any, list[int]]], owners: Sequence[int], draws: np.ndarray
) -> tuple[Any, Any]:
    """Return R answers to P prompts, as tokens (R, S) and the logits (R, S, V) by which they were chosen.

    Args:
        model: The checkpoint.
        prompts: The pixels (C, S, S) and tokens of each prompt.
        owners: (R,), the prompt of each answer; a prompt with several answers is read once.
        draws: (R, S), for `ActionBins.choose`.
    """
    torch = require("torch")
    with torch.inference_mode():
        uniform = torch.tensor(draws, device=model.device)
        embeddings, mask = _left_padded(model, prompts)
        language = model.network.language_model
        positions = (mask.cumsum(-1) - 1).clamp(min=0)
        read = language.model(inputs_embeds=embeddings, attention_mask=mask, position_ids=positions, use_cache=True)
        index = torch.tensor(owners, device=model.device)
        hidden, mask, position = read.last_hidden_state[index, -1], mask[index], positions[index, -1:]
        cache = tuple((keys[index], values[index]) for keys, values in read.past_key_values)
        chosen: list[Any] = []
        logits: list[Any] = []
        for step in range(draws.shape[1]):
            if step:
                mask = torch.cat([mask, mask.new_ones(len(mask), 1)], 1)
                read = language.model(
                    input_ids=chosen[-1][:, None],
                    attention_mask=mask,
                    position_ids=position + step,
                    past_key_values=cache,
                    use_cache=True,
                )
                hidden, cache = read.last_hidden_state[:, -1], read.past_key_values
            logits.append(language.lm_head(hidden).float())
            chosen.append(model.bins.choose(logits[-1], uniform[:, step]))
        return torch.stack(chosen, 1), torch.stack(logits, 1)


def _left_padded(model: Prismatic, prompts: Sequence[tuple[Any, list[int]]]) -> tuple[Any, Any]:
    """Return embeddings (P, L, D) and their mask (P, L), with the patches after the first token, as in training."""
    torch = require("torch")
    patches = model.network.projector(model.network.vision_backbone(model.to_device([pixels for pixels, _ in prompts])))
    rows = []
    for seen, (_, tokens) in zip(patches, prompts, strict=True):
        words = model.embed(tokens)
        rows.append(torch.cat([words[:1], seen, words[1:]]))
    length = max(map(len, rows))
    embeddings = patches.new_zeros(len(rows), length, patches.shape[-1])
    mask = torch.zeros(len(rows), length, dtype=torch.long, device=model.device)
    for i, row in enumerate(rows):
        embeddings[i, -len(row) :] = row
        mask[i, -len(row) :] = 1
    return embeddings, mask
