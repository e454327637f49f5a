"""A student whose actions are tokens, as those of OpenVLA, for learners of GRPO."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.learn.tabletop.student import ACTION, Student, head, looking, seeded

TOKENS = 11  # bins of each number of an action, whose middles are from -1 to 1


def tokens_of(actions: np.ndarray) -> np.ndarray:
    """Return the nearest token of each number of actions, int64; those beyond [-1, 1] have the outermost."""
    found: np.ndarray = np.rint((np.clip(actions, -1.0, 1.0) + 1.0) / 2 * (TOKENS - 1)).astype(np.int64)
    return found


def actions_of(tokens: np.ndarray) -> np.ndarray:
    """Return the actions of tokens, float32: the middles of their bins."""
    found: np.ndarray = np.linspace(-1.0, 1.0, TOKENS, dtype=np.float32)[tokens]
    return found


def make_token_network(seed: int = 0) -> Any:
    """Return a new network: inputs (B, INPUTS) to log-probabilities (B, 4, TOKENS) and entropies (B,), nats."""

    class TokenNetwork(looking()):  # type: ignore[misc]
        """Chooses a token for each number of an action by the features."""

        def __init__(self) -> None:
            super().__init__()
            self.policy = head(ACTION * TOKENS)

        def forward(self, inputs: Any) -> tuple[Any, Any]:
            logprobs = self.policy(self.features(inputs)).unflatten(-1, (ACTION, TOKENS)).log_softmax(-1)
            return logprobs, -(logprobs.exp() * logprobs).sum((-2, -1))

    return seeded(TokenNetwork, seed)


class TokenStudent(Student):
    """Acts by the likeliest tokens, or draws them at temperature 1 if something is wanted for a learner."""

    behaviour = ("logprob", "entropy", "replay")
    make_network = staticmethod(make_token_network)

    def _best(self, *outputs: Any) -> np.ndarray:
        return actions_of(outputs[0].argmax(-1))

    def _draw(self, draws: np.random.Generator, *outputs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        logprobs, entropy = outputs
        tokens = (logprobs + draws.gumbel(size=logprobs.shape)).argmax(-1)  # drawn from the softmax: the Gumbel trick
        logprob = np.take_along_axis(logprobs, tokens[:, None], -1)[:, 0]
        said = {"logprob": logprob[None], "entropy": float(entropy), "replay": {"tokens": tokens[None]}}
        return actions_of(tokens), said
