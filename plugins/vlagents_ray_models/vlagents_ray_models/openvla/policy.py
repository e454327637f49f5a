"""OpenVLA: decodes the next action from an image and an instruction, token by token.

Upstream's `predict_action` takes one prompt and calls `generate`. Here prompts of different lengths
are padded on the left, with masks and positions that give each the same result as alone, and share
every forward pass. Keys and values are one tensor of a fixed length, with a masked place for each
future token.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.interface import Obs
from vlagents_ray.policies.adapters import LoraAdapters
from vlagents_ray.policies.base import Prediction, Row
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras
from vlagents_ray.policies.base.staging import StagedRow
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require
from vlagents_ray_models.key_value_cache import stack_of
from vlagents_ray_models.openvla import prismatic

_IMAGE = "image"  # the model's only camera


class OpenVLAConfig(prismatic.PrismaticConfig):
    """Settings of OpenVLA."""

    center_crop: bool = Field(
        default=False,
        description="for checkpoints trained with random crops, such as LIBERO's: pictures go "
        "through JPEG and Lanczos "
        "to 224 px, and the middle nine tenths of them to the model; else the checkpoint's own "
        "resizing is all",
    )


class OpenVLA(prismatic.PrismaticPolicy):
    """The policy OpenVLA, which returns one action for each `act`."""

    Config = OpenVLAConfig
    config: OpenVLAConfig
    model: TokenDecoder
    trainable = "model.base.network"
    adaptable = True

    def __init__(self, config: OpenVLAConfig) -> None:
        super().__init__(config)
        self._cameras = choose_cameras(config.cameras, {_IMAGE: "front"}, [_IMAGE])

    @property
    def contract(self) -> Contract:
        facts = {
            "action": self._action(),
            "gripper": None,
            "behaviour": self.offered(prismatic.OFFERED),
        }
        return self.stated(self._cameras, (), 1, **facts)

    def load(self) -> TokenDecoder:
        base = prismatic.load_prismatic(self.config)
        if self.config.attention != "flash_attention_2":  # which reads the mask as it is
            model = base.network.language_model.model
            model._update_causal_mask = partial(_causal_mask, model._update_causal_mask)
        decoder = TokenDecoder(
            base, max(base.statistics.action_dims(self.config.unnorm_key)), self.adapters
        )
        decoder.compile_with(self.compilation)
        return decoder

    def perceive(self, obs: Obs) -> StagedRow:
        image = camera_images(obs, self._cameras)[_IMAGE]
        if self.config.center_crop:
            image = prismatic.middle(prismatic.resized(image))
        return self.model.base.stage([image])

    def _model_input(self, row: Row, key: str) -> tuple[StagedRow, list[int]]:
        return row.frames[-1], self.model.base.tokens(row.instruction)

    def _compute(self, prepared: Sequence[prismatic.PreparedRow]) -> list[Prediction]:
        """Decode all answers: sessions greedily unless outputs are requested, samples at
        temperature 1.
        """
        firsts, owners = self.observations_of([entry.row for entry in prepared])
        draws = np.full((len(prepared), max(entry.scale.dim for entry in prepared)), np.nan)
        for numbers, entry in zip(draws, prepared, strict=True):
            if entry.row.sample:
                numbers[: entry.scale.dim] = entry.row.rng.random(entry.scale.dim)
        seen = [prepared[i] for i in firsts]
        tokens, over = self.model.decode(
            [entry.model_input for entry in seen],
            owners,
            draws,
            [entry.row.adapter for entry in seen],
        )
        return self._decoded(self.model.base.bins, prepared, tokens[:, None], over[:, None])


@dataclass
class TokenDecoder:
    """A checkpoint and its passes: functions of tensors, which `compile_with` replaces by their
    compiled forms.
    """

    base: prismatic.Prismatic
    longest: int  # the largest number of tokens of an answer
    adapters: LoraAdapters = field(default_factory=LoraAdapters)  # of the policy

    def compile_with(self, compilation: Compilation) -> None:
        self.encode_images = compilation.core("vision encoder", self.encode_images)  # type: ignore[method-assign]
        self.prefill = compilation.core("language model", self.prefill)  # type: ignore[method-assign]
        self.continue_from = compilation.core("next token", self.continue_from)  # type: ignore[method-assign]

    def decode(
        self,
        prompts: Sequence[tuple[StagedRow, list[int]]],
        owners: Sequence[int],
        draws: np.ndarray,
        fingerprints: Sequence[str] = (),
    ) -> tuple[Any, Any]:
        """Decode R answers to P prompts.

        Args:
            prompts: The image and the tokens of each prompt.
            owners: (R,), the prompt of each answer; a prompt with several answers is read once.
            draws: (R, S), for `ActionBins.choose`.
            fingerprints: (P,), the adapter of each prompt, see `Row.adapter`; empty: no prompt has
                one.

        Returns:
            Tokens (R, S), and the logits of the bins (R, S, bins) there.
        """
        torch, base, steps = require("torch"), self.base, draws.shape[1]
        with torch.inference_mode(), self.adapters.rows(fingerprints):
            uniform = base.moved(draws)
            embeddings, mask = self._left_padded(prompts)
            hidden, cache = self.prefill(embeddings, mask)
        with (
            torch.inference_mode(),
            self.adapters.rows([fingerprints[i] for i in owners] if fingerprints else ()),
        ):
            if list(owners) != list(range(len(prompts))):
                index = base.moved(owners)
                hidden, mask, cache = hidden[index], mask[index], cache[index]
            length, position = mask.shape[1], mask.sum(1)
            # one place for each token but the last, and one at the end for the current token
            places = max(steps, self.longest)
            cache = torch.nn.functional.pad(cache, (0, 0, 0, places - 1))
            mask = torch.nn.functional.pad(mask, (0, places))
            mask[:, -1] = 1
            chosen: list[Any] = []
            found: list[Any] = []
            for step in range(steps):
                if step:
                    hidden, own = self.continue_from(chosen[-1], position + step - 1, mask, cache)
                    place = length + step - 1
                    cache[..., place, :], mask[:, place] = own, 1
                likeliest, over = base.bins.read(base.network.language_model.lm_head(hidden))
                found.append(over)
                chosen.append(base.bins.choose(likeliest, over, uniform[:, step]))
            return torch.stack(chosen, 1), torch.stack(found, 1)

    def encode_images(self, pixels: Any) -> Any:
        """Return the embeddings (P, N, D) of images (P, C, S, S)."""
        network = self.base.network
        return network.projector(network.vision_backbone(pixels))

    def prefill(self, embeddings: Any, mask: Any) -> tuple[Any, Any]:
        """Run the language model on prompts (P, L, D), whose tokens are where `mask` (P, L) is not
        0.

        Returns the last hidden state (P, D), and keys and values (P, layers, 2, heads, L, E).
        """
        result = self.base.network.language_model.model(
            inputs_embeds=embeddings,
            attention_mask=mask,
            position_ids=(mask.cumsum(-1) - 1).clamp(min=0),
            use_cache=True,
        )
        return result.last_hidden_state[:, -1], stack_of(result.past_key_values)

    def continue_from(self, tokens: Any, positions: Any, mask: Any, cache: Any) -> tuple[Any, Any]:
        """Run the language model on one more token (R,) of each row, at `positions` (R,) of its
        text.

        A token attends where `mask` (R, T + 1) is not 0: T places of keys and values (R, layers, 2,
        heads, T, E), and itself. Returns the hidden state (R, D), and the token's own keys and
        values (R, layers, 2, heads, E).
        """
        result = self.base.network.language_model.model(
            input_ids=tokens[:, None],
            attention_mask=mask,
            position_ids=positions[:, None],
            past_key_values=tuple((layer[:, 0], layer[:, 1]) for layer in cache.unbind(1)),
            use_cache=True,
        )
        own = tuple((keys[:, :, -1:], values[:, :, -1:]) for keys, values in result.past_key_values)
        return result.last_hidden_state[:, -1], stack_of(own)[..., 0, :]

    def _left_padded(self, prompts: Sequence[tuple[StagedRow, list[int]]]) -> tuple[Any, Any]:
        """Return embeddings (P, L, D) and their mask (P, L); the patches follow the first token,
        as in training.
        """
        base, rows = self.base, [tokens for _, tokens in prompts]
        patches = self.encode_images(base.pixels([seen for seen, _ in prompts]).flatten(0, 1))
        first = 1 + patches.shape[1]  # place of a row's first token
        places = [
            [first, *range(1, first), *range(first + 1, first + len(tokens))] for tokens in rows
        ]
        length = first - 1 + base.padded_tokens
        index = base.padded(places, length, left=True)
        return base.assembled([patches, base.embed(base.padded(rows))], index), (index > 0).long()


def _causal_mask(
    own: Callable[..., Any], mask: Any, embeddings: Any, positions: Any, *others: Any
) -> Any:
    """Return Llama's mask (B, 1, Q, K) of tokens (B, Q, D) at positions (Q,) that attend where
    `mask` (B, K) is not 0.

    Its `own` code reads whether anything is masked: each pass would wait for a GPU, and no graph
    could be captured.
    """
    import torch  # the compiler follows an import statement, but not `require`

    if mask is None or mask.ndim != 2:
        return own(mask, embeddings, positions, *others)
    hidden = (torch.arange(mask.shape[1], device=mask.device) > positions[:, None]) | (
        mask[:, None] == 0
    )
    # Padding attends to all: fast kernels give NaN for no token at all.
    hidden = hidden & ~hidden.all(-1, keepdim=True)
    shown = torch.zeros_like(hidden, dtype=embeddings.dtype)
    return shown.masked_fill(hidden, torch.finfo(embeddings.dtype).min)[:, None]
