"""OpenVLA, which decodes the next action from an image and an instruction, token by token.

Upstream's `predict_action` accepts one prompt and calls `generate`. Here, prompts of different
lengths share every forward pass. They are padded on the left, with masks and positions that give
each prompt the same result as alone. Keys and values are one tensor of a fixed length, with a
masked entry for each future token.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import AdapterConfig, Prediction, Row
from vlagents_ray.policies.base.model_inputs import camera_images, choose_cameras
from vlagents_ray.policies.base.staging import StagedRow
from vlagents_ray.policies.compilation import Compilation, held
from vlagents_ray.registry import require
from vlagents_ray_models.key_value_cache import stack_of
from vlagents_ray_models.openvla import prismatic

_IMAGE = "image"  # name of the model's only camera
_CACHE = 3  # index of the argument `cache` of `TokenDecoder.continue_from`


class OpenVLAConfig(prismatic.PrismaticConfig, AdapterConfig):
    """Settings of OpenVLA."""

    center_crop: bool = Field(
        default=False,
        description="for checkpoints trained with random crops, such as LIBERO's: images are "
        "compressed as JPEG and resized to 224 px with Lanczos, and the model receives the "
        "central nine tenths of their area; otherwise only the checkpoint's own resizing is "
        "applied",
    )


class OpenVLA(prismatic.PrismaticPolicy):
    """The policy OpenVLA, which returns one action for each call."""

    Config = OpenVLAConfig
    config: OpenVLAConfig
    model: TokenDecoder
    trainable = "model.base.network"

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
        return self.make_contract(self._cameras, (), 1, **facts)

    def load(self) -> TokenDecoder:
        """Read the checkpoint.

        Raises:
            ConfigError: The checkpoint is incomplete, or the settings do not fit it.
        """
        base = prismatic.load_prismatic(self.config, adapter=self.adapter)
        if self.config.attention != "flash_attention_2":  # this attention uses the mask unchanged
            model = base.network.language_model.model
            model._update_causal_mask = partial(_causal_mask, model._update_causal_mask)

        longest = max(base.statistics.action_dims(self.config.unnorm_key))
        decoder = TokenDecoder(base, longest)
        decoder.compile_with(self.compilation)
        return decoder

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the camera's image as the input of the vision backbones."""
        image = camera_images(obs, self._cameras)[_IMAGE]
        if self.config.center_crop:
            image = prismatic.crop_center(prismatic.resize(image))
        return self.model.base.stage([image])

    def _model_input(self, row: Row, key: str) -> tuple[StagedRow, list[int]]:
        return row.frames[-1], self.model.base.tokens(row.instruction)

    def _compute(self, prepared: Sequence[prismatic.PreparedRow]) -> list[Prediction]:
        """Decode all answers.

        Answers to sessions are decoded greedily unless outputs are requested, and samples are drawn
        at temperature 1.
        """
        draws = np.full((len(prepared), max(entry.scale.dim for entry in prepared)), np.nan)
        for row_draws, entry in zip(draws, prepared, strict=True):
            if entry.row.sample:
                row_draws[: entry.scale.dim] = entry.row.rng.random(entry.scale.dim)

        firsts, owners = self.observations_of([entry.row for entry in prepared])
        prompts = [prepared[i].model_input for i in firsts]
        tokens, bin_logits = self.model.decode(prompts, owners, draws)
        return self._decoded(self.model.base.bins, prepared, tokens[:, None], bin_logits[:, None])


@dataclass
class TokenDecoder:
    """A checkpoint and its forward passes.

    The passes are functions of tensors, which `compile_with` replaces with their compiled forms.
    """

    base: prismatic.Prismatic
    longest: int  # largest number of tokens in an answer

    def compile_with(self, compilation: Compilation) -> None:
        """Replace the passes with their compiled forms, if they are compiled."""
        self.encode_images = compilation.core("vision encoder", self.encode_images)  # type: ignore[method-assign]
        self.prefill = compilation.core("language model", self.prefill)  # type: ignore[method-assign]
        self.continue_from = compilation.core("next token", self.continue_from)  # type: ignore[method-assign]

    def decode(
        self,
        prompts: Sequence[tuple[StagedRow, list[int]]],
        owners: Sequence[int],
        draws: np.ndarray,
    ) -> tuple[Any, Any]:
        """Decode R answers to P prompts.

        Args:
            prompts: The image and the tokens of each prompt.
            owners: The index of the prompt of each answer, (R,). A prompt with several answers is
                processed once.
            draws: The draws for `ActionBins.choose`, (R, S), with a column for each token.

        Returns:
            The tokens, (R, S), and the logits of the bins from which they were chosen, (R, S,
            bins).
        """
        torch, base, steps = require("torch"), self.base, draws.shape[1]
        with torch.inference_mode():
            quantiles = base.upload(draws)
            embeddings, mask = self._left_padded(prompts)
            hidden, cache = self.prefill(embeddings, mask)

            if list(owners) != list(range(len(prompts))):
                index = base.upload(owners)
                hidden, mask, cache = hidden[index], mask[index], cache[index]
            length, position = mask.shape[1], mask.sum(1)

            # The mask has an entry for each token except the last, and an entry at the end for the
            # current token.
            entries = max(steps, self.longest)
            cache = torch.nn.functional.pad(cache, (0, 0, 0, entries - 1))
            mask = torch.nn.functional.pad(mask, (0, entries))
            mask[:, -1] = 1
            # The loop writes its entries directly into the tensor from which a CUDA graph reads,
            # since a copy of the cache for each token would take 155 MB per row.
            cache = held(self.continue_from, _CACHE, cache)

            tokens: list[Any] = []
            all_bin_logits: list[Any] = []
            for step in range(steps):
                if step:
                    hidden, keys_and_values = self.continue_from(
                        tokens[-1], position + step - 1, mask, cache
                    )
                    entry = length + step - 1
                    cache[..., entry, :] = keys_and_values
                    mask[:, entry] = 1
                logits = base.network.language_model.lm_head(hidden)
                likeliest, bin_logits = base.bins.read(logits)
                all_bin_logits.append(bin_logits)
                tokens.append(base.bins.choose(likeliest, bin_logits, quantiles[:, step]))
            return torch.stack(tokens, 1), torch.stack(all_bin_logits, 1)

    def encode_images(self, pixels: Any) -> Any:
        """Return the embeddings (P, N, D) of images (P, C, S, S)."""
        network = self.base.network
        return network.projector(network.vision_backbone(pixels))

    def prefill(self, embeddings: Any, mask: Any) -> tuple[Any, Any]:
        """Run the language model on prompts.

        Args:
            embeddings: The embeddings of the prompts, (P, L, D).
            mask: (P, L), 0 where a prompt is padded.

        Returns:
            The last hidden state (P, D), and keys and values (P, layers, 2, heads, L, E).
        """
        result = self.base.network.language_model.model(
            inputs_embeds=embeddings,
            attention_mask=mask,
            position_ids=(mask.cumsum(-1) - 1).clamp(min=0),
            use_cache=True,
        )
        return result.last_hidden_state[:, -1], stack_of(result.past_key_values)

    def continue_from(self, tokens: Any, positions: Any, mask: Any, cache: Any) -> tuple[Any, Any]:
        """Run the language model on the next token of each row.

        Args:
            tokens: The tokens, (R,).
            positions: Their positions in the texts of their rows, (R,).
            mask: The attention mask, (R, T + 1). It is 0 for each of the T cache entries to which a
                token does not attend. The last column is for the token itself.
            cache: Keys and values, (R, layers, 2, heads, T, E).

        Returns:
            The hidden state (R, D), and the token's keys and values (R, layers, 2, heads, E).
        """
        result = self.base.network.language_model.model(
            input_ids=tokens[:, None],
            attention_mask=mask,
            position_ids=positions[:, None],
            past_key_values=tuple((layer[:, 0], layer[:, 1]) for layer in cache.unbind(1)),
            use_cache=True,
        )
        of_token = tuple(
            (keys[:, :, -1:], values[:, :, -1:]) for keys, values in result.past_key_values
        )
        return result.last_hidden_state[:, -1], stack_of(of_token)[..., 0, :]

    def _left_padded(self, prompts: Sequence[tuple[StagedRow, list[int]]]) -> tuple[Any, Any]:
        """Return the embeddings (P, L, D) of prompts, and their mask (P, L).

        The patches of the image follow the first token, as in training.
        """
        base = self.base
        rows = [tokens for _, tokens in prompts]
        pixels = base.pixels([staged for staged, _ in prompts]).flatten(0, 1)
        patches = self.encode_images(pixels)

        # Indices into the concatenation of patches and tokens, counted from 1.
        first = 1 + patches.shape[1]  # the index of a row's first token
        order = [
            [first, *range(1, first), *range(first + 1, first + len(tokens))] for tokens in rows
        ]
        indices = base.pad(order, first - 1 + base.padded_tokens, left=True)
        embeddings = base.assemble([patches, base.embed(base.pad(rows))], indices)
        return embeddings, (indices > 0).long()


def _causal_mask(
    update_causal_mask: Callable[..., Any],
    mask: Any,
    embeddings: Any,
    positions: Any,
    *arguments: Any,
) -> Any:
    """Return the attention mask of Llama, without reading whether any token is masked.

    Llama's own code reads this from the GPU, so that each pass would wait for the GPU, and no graph
    could be captured.

    Args:
        update_causal_mask: Llama's own code, for masks of another shape.
        mask: (B, K), 0 at tokens to which no token attends; None if tokens attend to all.
        embeddings: The embeddings of the tokens, (B, Q, D).
        positions: The positions of the tokens in the cache, (Q,).
        arguments: Further arguments of Llama's code.

    Returns:
        (B, 1, Q, K): 0 where a token attends, otherwise the smallest number of the embeddings'
        type.
    """
    import torch  # the compiler follows an import statement, but not `require`

    if mask is None or mask.ndim != 2:
        return update_causal_mask(mask, embeddings, positions, *arguments)
    is_later = torch.arange(mask.shape[1], device=mask.device) > positions[:, None]
    hidden = is_later | (mask[:, None] == 0)
    # Padding attends to all tokens, since fast kernels return NaN for a token that attends to
    # nothing.
    hidden = hidden & ~hidden.all(-1, keepdim=True)
    shown = torch.zeros_like(hidden, dtype=embeddings.dtype)
    return shown.masked_fill(hidden, torch.finfo(embeddings.dtype).min)[:, None]
