"""A greedy decode of many prompts at once.

Upstream's `predict_action` takes one prompt and calls `generate`. Here prompts of different lengths are padded on the
left, with masks and positions that leave each as it is alone, and share every forward pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.openvla.prismatic import Prismatic
from vlagents_ray.registry import require


def decode(
    model: Prismatic, prompts: Sequence[tuple[Any, list[int]]], owners: Sequence[int], draws: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R answers to P prompts, (R, S) in [-1, 1], and mean and deviation of the bins that each token was chosen from.

    Args:
        model: the checkpoint.
        prompts: pixels (C, S, S) and tokens, each.
        owners: (R,) the prompt of each answer; one that has several is read once.
        draws: (R, S) for `ActionBins.choose`.
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
        return model.bins.values(torch.stack(chosen, 1)), *model.bins.moments(torch.stack(logits, 1))


def _left_padded(model: Prismatic, prompts: Sequence[tuple[Any, list[int]]]) -> tuple[Any, Any]:
    """Embeddings (P, L, D) and their mask (P, L): the patches stand behind the first token, as in training."""
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
