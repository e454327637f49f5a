"""Action tokens, and the bins of [-1, 1] that they stand for."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.registry import require


class ActionBins:
    """The last tokens of the vocabulary, the last one being the lowest bin of [-1, 1]."""

    def __init__(self, config: Any, device: Any) -> None:
        torch = require("torch")
        edges = np.linspace(-1, 1, config.n_action_bins)
        middles = (edges[:-1] + edges[1:]) / 2
        self._first = config.text_config.vocab_size - config.pad_to_multiple_of - 1
        self._middles = torch.tensor(np.append(middles, middles[-1]), device=device)  # tokens are one more
        self._tokens = self._first - torch.arange(config.n_action_bins, device=device)

    def choose(self, logits: Any, draws: Any) -> Any:
        """Tokens (…) for logits (…, V): the likeliest of all, or, where `draws` (…) is a number in [0, 1), not NaN,
        the bin at that quantile of the distribution over bins.
        """
        torch = require("torch")
        upto = self._over_bins(logits).cumsum(-1)
        drawn = (upto > (draws * upto[..., -1])[..., None]).int().argmax(-1)
        return torch.where(draws.isnan(), logits.argmax(-1), self._tokens[drawn])

    def values(self, tokens: Any) -> np.ndarray:
        """In [-1, 1]; a token that is no bin counts as the nearest one, as upstream."""
        bins = (self._first - tokens).clamp(0, len(self._middles) - 1)
        return np.asarray(self._middles[bins].cpu())

    def moments(self, logits: Any) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (…) of the distribution over bins."""
        over = self._over_bins(logits)
        mean = over @ self._middles
        spread = (over * (self._middles - mean[..., None]) ** 2).sum(-1).sqrt()
        return np.asarray(mean.cpu()), np.asarray(spread.cpu())

    def _over_bins(self, logits: Any) -> Any:
        return logits[..., self._tokens].double().softmax(-1)
