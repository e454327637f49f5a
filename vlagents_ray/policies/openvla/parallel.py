"""OFT's parallel decoding: all actions of a chunk in one forward pass, each token attending to all others.

Upstream runs a fork of transformers whose Llama attention, with SDPA, has no causal mask. The original does the same
with a mask of four dimensions, (B, 1, L, L), that states to which tokens each one attends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.openvla.components import Film, Mlp, Projector
from vlagents_ray.policies.openvla.prismatic import Prismatic
from vlagents_ray.registry import require

_STOP = 2  # Llama's end of text, which follows the actions in training


@dataclass(frozen=True)
class ModelInput:
    """The inputs for one chunk."""

    pictures: tuple[Any, ...]  # (C, S, S) float32 each, in the order of training
    tokens: list[int]
    proprio: np.ndarray | None  # (P,) in [-1, 1]


@dataclass
class Parallel:
    """A checkpoint of OFT: OpenVLA's, and its components; components that it was trained without are None.

    `look` and `attend` are functions of tensors, which `compile_with` replaces by their compiled forms.
    """

    base: Prismatic
    horizon: int  # H, the number of rows of a chunk
    dim: int  # D, the length of a row
    head: Mlp | None  # None: action tokens
    proprio: Projector | None
    noisy: Projector | None  # embeds noisy actions: the head is a diffusion head
    film: Film | None
    steps: tuple[int, int]  # diffusion steps: in training, at inference

    def compile_with(self, compilation: Compilation) -> None:
        """Mark what of the model is compiled."""
        self.look = compilation.core("look", self.look)  # type: ignore[method-assign]
        self.attend = compilation.core("attend", self.attend)  # type: ignore[method-assign]

    def regress(self, inputs: Sequence[ModelInput]) -> np.ndarray:
        """Return chunks (B, H, D) in [-1, 1] of the regression head."""
        with require("torch").inference_mode():
            return _numpy(self._heads(self._hidden(self._sequences(inputs))))

    def denoise(self, inputs: Sequence[ModelInput], owners: Sequence[int], noise: np.ndarray) -> np.ndarray:
        """Return chunks (B, H, D) in [-1, 1] of the diffusion head, from noise of that shape.

        `owners` (B,) names the input of each chunk; its images are encoded once.
        """
        torch = require("torch")
        with torch.inference_mode():
            sequences = self._sequences(inputs)
            seen = [sequences[owner] for owner in owners]
            start = self.base.to_device(torch.from_numpy(noise))
            return _numpy(denoise(start, lambda time, noisy: self._noise(seen, time, noisy), *self.steps))

    def choose(self, inputs: Sequence[ModelInput], owners: Sequence[int], draws: np.ndarray) -> tuple[Any, Any]:
        """Return the tokens (B, H, D) of chunks, and the logits (B, H, D, V) by which they were chosen.

        `owners` (B,) names the input of each chunk, which is computed once; `draws` (B, H, D) are those of
        `ActionBins.choose`.
        """
        torch = require("torch")
        with torch.inference_mode():
            hidden = self._hidden(self._sequences(inputs)).unflatten(1, (self.horizon, self.dim))
            logits = self.base.network.language_model.lm_head(hidden).float()[list(owners)]
            return self.base.bins.choose(logits, torch.tensor(draws, device=self.base.device)), logits

    def _heads(self, hidden: Any) -> Any:
        return self.head(hidden.reshape(len(hidden), self.horizon, -1))  # type: ignore[misc]

    def _noise(self, seen: Sequence[tuple[Any, Any]], time: int, actions: Any) -> Any:
        now = time_embedding(time, seen[0][0].shape[-1], actions.device).to(actions.dtype)[None]
        noisy = self.noisy(actions.flatten(1)[..., None])  # type: ignore[misc]
        return self._heads(self._hidden([(require("torch").cat([s, now]), w) for s, w in seen], noisy))

    def _sequences(self, inputs: Sequence[ModelInput]) -> list[tuple[Any, Any]]:
        """Return, for each input, the embeddings of images and state (P, D), and of the words (L, D)."""
        torch = require("torch")
        words = [self.base.embed([*model_input.tokens, _STOP]) for model_input in inputs]
        views = len(inputs[0].pictures)
        pixels = self.base.to_device([picture for model_input in inputs for picture in model_input.pictures])
        language = torch.stack([one.mean(0) for one in words])
        seen = self.look(pixels.unflatten(0, (len(inputs), views)), language)
        if self.proprio is not None:
            states = self.base.to_device([torch.from_numpy(model_input.proprio) for model_input in inputs])
            seen = torch.cat([seen, self.proprio(states)[:, None]], 1)
        return list(zip(seen, words, strict=True))

    def look(self, pixels: Any, language: Any) -> Any:
        """Return the embeddings (P, N, D) of images (P, views, C, S, S); `language` is the mean of words (P, D)."""
        views = pixels.shape[1]
        images = pixels.flatten(0, 1)
        if self.film is None:
            patches = self.base.network.vision_backbone(images)
        else:
            patches = self.film(images, language.repeat_interleave(views, 0))
        return self.base.network.projector(patches).unflatten(0, (len(pixels), views)).flatten(1, 2)

    def attend(self, embeddings: Any, lengths: Any) -> Any:
        """Return hidden states (B, L, D) of sequences (B, L, D), each token attending to all of its row's length."""
        import torch  # the compiler follows a statement, and not `require`

        model, length = self.base.network.language_model.model, embeddings.shape[1]
        places = lengths.new_ones(1, length).cumsum(1) - 1
        hidden = (places >= lengths[:, None])[:, None, None].expand(-1, 1, length, -1)
        mask = embeddings.new_zeros(1).expand(hidden.shape).masked_fill(hidden, torch.finfo(embeddings.dtype).min)
        for layer in model.layers:
            [embeddings] = layer(embeddings, attention_mask=mask, position_ids=places)
        return model.norm(embeddings)

    def _hidden(self, sequences: Sequence[tuple[Any, Any]], actions: Any = None) -> Any:
        """Return hidden states (B, H * D, …) of the action tokens, which are `actions` or zeros.

        Padded on the right.
        """
        torch = require("torch")
        count = self.horizon * self.dim
        if actions is None:
            actions = sequences[0][0].new_zeros(len(sequences), count, sequences[0][0].shape[-1])
        rows = [
            torch.cat([words[:1], seen, words[1:-1], tokens, words[-1:]])
            for (seen, words), tokens in zip(sequences, actions, strict=True)
        ]
        embeddings = torch.nn.utils.rnn.pad_sequence(rows, batch_first=True)
        missing = max(0, self.base.padded_tokens - max(len(words) for _, words in sequences))
        embeddings = torch.nn.functional.pad(embeddings, (0, 0, 0, missing))
        lengths = torch.tensor([len(row) for row in rows], device=self.base.device)
        hidden = self.attend(embeddings, lengths)
        starts = lengths - count - 2  # the token before an action predicts it, as in training
        places = starts[:, None] + torch.arange(count, device=self.base.device)
        return hidden[torch.arange(len(rows))[:, None], places]


def _numpy(tensor: Any) -> np.ndarray:
    array: np.ndarray = tensor.float().cpu().numpy()
    return array


def denoise(noise: Any, predict: Callable[[int, Any], Any], trained: int, steps: int) -> Any:
    """Return actions (B, H, D) in [-1, 1] from noise.

    `predict` returns the noise in them at a time of training's scale.
    """
    kept = _kept(trained)
    for time, before in _times(trained, steps):
        guessed = predict(time, noise)
        clean = (noise - (1 - kept[time]) ** 0.5 * guessed) / kept[time] ** 0.5
        left = kept[before] if before >= 0 else 1.0
        noise = left**0.5 * clean.clamp(-1, 1) + (1 - left) ** 0.5 * guessed
    return noise


def time_embedding(time: int, dim: int, device: Any) -> Any:
    """Return (dim,) float32, sines and then cosines."""
    torch = require("torch")
    half = dim // 2
    rates = torch.exp(torch.arange(half, device=device) * -math.log(10000) / (half - 1))
    return torch.cat([(time * rates).sin(), (time * rates).cos()])


def _times(trained: int, steps: int) -> Iterator[tuple[int, int]]:
    stride = trained // steps
    for i in reversed(range(steps)):
        yield i * stride, (i - 1) * stride


def _kept(trained: int) -> list[float]:
    """Return the share of the signal that remains at each time of training."""

    def alpha(x: float) -> float:
        return math.cos((x + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - alpha((i + 1) / trained) / alpha(i / trained), 0.999) for i in range(trained)]
    kept: list[float] = np.cumprod(1 - np.array(betas, np.float32)).tolist()
    return kept
