"""A student whose actions are tokens, like OpenVLA's actions, for learning with GRPO."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from student import ACTION, LookingNetwork, Student, head

TOKENS = 11  # number of bins for each value of an action; the centres of the bins are from -1 to 1


def tokens_of(actions: np.ndarray) -> np.ndarray:
    """Return the nearest token of each number of actions, int64.

    Numbers outside of [-1, 1] have the outermost token.
    """
    found: np.ndarray = np.rint((np.clip(actions, -1.0, 1.0) + 1.0) / 2 * (TOKENS - 1)).astype(
        np.int64
    )
    return found


def actions_of(tokens: np.ndarray) -> np.ndarray:
    """Return the actions of tokens, float32: the centres of the tokens' bins."""
    found: np.ndarray = np.linspace(-1.0, 1.0, TOKENS, dtype=np.float32)[tokens]
    return found


class TokenNetwork(LookingNetwork):
    """Maps inputs (B, INPUTS) to log-probabilities of tokens (B, 4, TOKENS) and entropies (B,),
    nats.
    """

    def __init__(self) -> None:
        super().__init__()
        self.policy = head(ACTION * TOKENS)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        logprobs = (
            self.policy(self.features(inputs)).unflatten(-1, (ACTION, TOKENS)).log_softmax(-1)
        )
        return logprobs, -(logprobs.exp() * logprobs).sum((-2, -1))


class TokenStudent(Student):
    """Returns the most likely tokens, or draws tokens at temperature 1 if a learner requests
    values.
    """

    behaviour = ("logprob", "entropy", "replay")
    network_class = TokenNetwork

    def _best(self, *outputs: Any) -> np.ndarray:
        return actions_of(outputs[0].argmax(-1))

    def _draw(self, draws: np.random.Generator, *outputs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        logprobs, entropy = outputs
        # With Gumbel noise, the maximum is a draw from the softmax.
        tokens = (logprobs + draws.gumbel(size=logprobs.shape)).argmax(-1)
        logprob = np.take_along_axis(logprobs, tokens[:, None], -1)[:, 0]
        said = {
            "logprob": logprob[None],
            "entropy": float(entropy),
            "replay": {"tokens": tokens[None]},
        }
        return actions_of(tokens), said
