"""The learner of a student whose actions are tokens: behaviour cloning, and GRPO."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from learner import NetworkLearner, episodes, inputs_of, until_solved
from token_student import TokenNetwork, tokens_of

_EPSILON = 1e-6  # added to the standard deviation of a group


def group_advantages(columns: Mapping[str, np.ndarray], discount: float = 1.0) -> np.ndarray:
    """Return the advantages of the actions, (T,) float32, within groups of episodes from the same
    start state.

    An episode's reward is 1 if the task was solved at any step, times the discount for each step
    before that one. Each action of the episode has the advantage (reward - mean of the group) /
    (standard deviation of the group + 1e-6) (GRPO, arXiv 2402.03300). The advantage is 0 after the
    task was solved, and in groups of equal rewards (DAPO, arXiv 2503.14476).
    """
    starts, lengths = episodes(columns)
    kept = until_solved(columns)
    solved = np.logical_or.reduceat(columns["success"], starts)
    reward = solved * discount ** (np.add.reduceat(kept.astype(np.float64), starts) - 1)
    group = columns["episode"][starts]
    gain = np.zeros(len(starts))
    for number in np.unique(group):
        members = group == number
        gain[members] = (reward[members] - reward[members].mean()) / (
            reward[members].std() + _EPSILON
        )
    return np.where(kept, np.repeat(gain, lengths), 0.0).astype(np.float32)


class GRPOLearner(NetworkLearner):
    """Trains the network of a student whose actions are tokens."""

    want = ("logprob", "replay")
    batch = 512
    steps_at_once = 20
    rate = 1e-4  # with few episodes, larger or more steps would mostly fit noise
    network_class = TokenNetwork

    def improve(self, columns: Mapping[str, np.ndarray], steps: int) -> None:
        """Take steps of GRPO on the transitions of the student's own episodes, without a value and
        a reference policy.

        Args:
            columns: The transitions, with `logprob` and `replay.tokens`, of whole groups of
                episodes.
            steps: The number of steps. No step is taken if no group has both solved and unsolved
                episodes.
        """
        gain = group_advantages(columns)
        kept = np.flatnonzero(gain)
        if not len(kept):
            return
        seen, tokens = inputs_of(columns), columns["replay.tokens"][:, 0]
        rng = self._begin_improving()
        for _ in range(steps):
            rows = kept[self._drawn(rng, len(kept))]
            logprob = self._logprob(self._tensor(seen, rows), tokens[rows]).sum(-1)
            ratio = (logprob - self._tensor(columns["logprob"], rows)).exp()
            self._step(-self._clipped(ratio, self._tensor(gain, rows)))

    def _error(self, seen: Any, actions: np.ndarray) -> Any:
        """Return the cross-entropy of the actions' tokens, nats per token."""
        return -self._logprob(seen, tokens_of(actions)).mean()

    def _logprob(self, seen: Any, tokens: np.ndarray) -> Any:
        """Return the log-probabilities of tokens, (B, 4)."""
        logprobs, _ = self.network(seen)
        return logprobs.gather(-1, torch.from_numpy(tokens)[..., None]).squeeze(-1)
