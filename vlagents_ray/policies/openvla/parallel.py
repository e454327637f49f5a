"""OFT's parallel decode: all actions of a chunk in one forward pass, each token seeing all the others.

Upstream runs a fork of transformers whose Llama attention, with SDPA, has no causal mask. The plain one does the same
when it is handed a mask of four dimensions, (B, 1, L, L), which says whom each token sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.policies.openvla.components import Film, Mlp, Projector
from vlagents_ray.policies.openvla.denoising import denoise, time_embedding
from vlagents_ray.policies.openvla.prismatic import Prismatic
from vlagents_ray.registry import require

_STOP = 2  # Llama's end of text, which stands behind the actions in training


@dataclass(frozen=True)
class Question:
    """What one chunk is asked for."""

    pictures: tuple[Any, ...]  # (C, S, S) float32 each, in the order of training
    tokens: list[int]
    proprio: np.ndarray | None  # (P,) in [-1, 1]


@dataclass(frozen=True)
class Parallel:
    """A checkpoint of OFT: OpenVLA's, and its components; those that it was trained without are None."""

    base: Prismatic
    horizon: int  # H, rows of a chunk
    dim: int  # D, numbers of a row
    head: Mlp | None  # None: action tokens
    proprio: Projector | None
    noisy: Projector | None  # of noisy actions: the head is a diffusion's
    film: Film | None
    steps: tuple[int, int]  # of diffusion: in training, here

    def regress(self, questions: Sequence[Question]) -> np.ndarray:
        """Chunks (B, H, D) in [-1, 1] of the regression head."""
        with require("torch").inference_mode():
            return _numpy(self._heads(self._hidden(self._sequences(questions))))

    def denoise(self, questions: Sequence[Question], noise: np.ndarray) -> np.ndarray:
        """Chunks (B, H, D) in [-1, 1] of the diffusion head, from noise of that shape."""
        torch = require("torch")
        with torch.inference_mode():
            seen = self._sequences(questions)
            start = self.base.to_device(torch.from_numpy(noise))
            return _numpy(denoise(start, lambda time, noisy: self._noise(seen, time, noisy), *self.steps))

    def choose(self, questions: Sequence[Question], draws: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Chunks (B, H, D) in [-1, 1] by action tokens, and mean and deviation of the bins they were chosen from.

        `draws` (B, H, D) are as `ActionBins.choose` takes them.
        """
        torch = require("torch")
        with torch.inference_mode():
            hidden = self._hidden(self._sequences(questions)).unflatten(1, (self.horizon, self.dim))
            logits = self.base.network.language_model.lm_head(hidden).float()
            tokens = self.base.bins.choose(logits, torch.tensor(draws, device=self.base.device))
            return self.base.bins.values(tokens), *self.base.bins.moments(logits)

    def _heads(self, hidden: Any) -> Any:
        return self.head(hidden.reshape(len(hidden), self.horizon, -1))  # type: ignore[misc]

    def _noise(self, seen: Sequence[tuple[Any, Any]], time: int, actions: Any) -> Any:
        now = time_embedding(time, seen[0][0].shape[-1], actions.device).to(actions.dtype)[None]
        noisy = self.noisy(actions.flatten(1)[..., None])  # type: ignore[misc]
        return self._heads(self._hidden([(require("torch").cat([s, now]), w) for s, w in seen], noisy))

    def _sequences(self, questions: Sequence[Question]) -> list[tuple[Any, Any]]:
        """Embeddings of what is seen (P, D), and of the words (L, D), of each question."""
        torch = require("torch")
        words = [self.base.embed([*question.tokens, _STOP]) for question in questions]
        views = len(questions[0].pictures)
        pixels = self.base.to_device([picture for question in questions for picture in question.pictures])
        if self.film is None:
            patches = self.base.network.vision_backbone(pixels)
        else:
            language = torch.stack([one.mean(0) for one in words])
            patches = self.film(pixels, language.repeat_interleave(views, 0))
        seen = self.base.network.projector(patches).unflatten(0, (len(questions), views)).flatten(1, 2)
        if self.proprio is not None:
            states = self.base.to_device([torch.from_numpy(question.proprio) for question in questions])
            seen = torch.cat([seen, self.proprio(states)[:, None]], 1)
        return list(zip(seen, words, strict=True))

    def _hidden(self, sequences: Sequence[tuple[Any, Any]], actions: Any = None) -> Any:
        """Hidden states (B, H * D, …) of the action tokens, which are `actions` or zeros; padded on the right."""
        torch = require("torch")
        count = self.horizon * self.dim
        if actions is None:
            actions = sequences[0][0].new_zeros(len(sequences), count, sequences[0][0].shape[-1])
        rows = [
            torch.cat([words[:1], seen, words[1:-1], tokens, words[-1:]])
            for (seen, words), tokens in zip(sequences, actions, strict=True)
        ]
        embeddings = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
        lengths = torch.tensor([len(row) for row in rows], device=self.base.device)
        length = embeddings.shape[1]
        visible = torch.arange(length, device=self.base.device) < lengths[:, None]
        mask = visible[:, None, None].expand(-1, 1, length, -1).to(embeddings.dtype)
        hidden = self.base.network.language_model.model(inputs_embeds=embeddings, attention_mask=mask, use_cache=False)
        starts = lengths - count - 2  # the token before the first action answers for it, as in training
        places = starts[:, None] + torch.arange(count, device=self.base.device)
        return hidden.last_hidden_state[torch.arange(len(rows))[:, None], places]


def _numpy(tensor: Any) -> np.ndarray:
    array: np.ndarray = tensor.float().cpu().numpy()
    return array
