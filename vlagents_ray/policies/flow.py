"""Flow matching in random steps, so that an action chunk has a log-probability (Flow-SDE).

A flow's steps from noise to actions are deterministic, and the density of its actions is not known. The stochastic
differential equation with the same marginal distributions at each time (Song et al. 2021, arXiv 2011.13456) makes each
step a normal distribution, and the steps a Markov chain whose log-probability is a sum. Learners that fine-tune flows
train with it: Flow-GRPO (arXiv 2505.05470), whose noise schedule this is, and πRL (arXiv 2510.25889).

Flow time is openpi's: 1 is noise, 0 is the actions, and the velocity is noise minus actions. The functions take arrays
of any library, and are differentiable there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vlagents_ray.policies.base.model_inputs import Row

OFFERED = ("logprob", "entropy", "replay")  # of chunks that come out of random steps
_LOG_2_PI = math.log(2 * math.pi)


Change = Callable[[Any, Any, float], Any]
"""The velocity (B, H, D), noisy actions (B, H, D) and flow time of a step -> the velocity that it takes."""


def follow(velocity: Callable[[Any, float], Any], noise: Any, steps: int, *changes: Change) -> Any:
    """Integrate noise (B, H, D) to actions in Euler steps, from flow time 1 to 0.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time in (0, 1].
        noise: The actions at time 1.
        steps: The number of steps.
        changes: Applied to the velocity of each step, one after another.
    """
    actions = noise
    for step in range(steps):
        time = 1.0 - step / steps
        taken = velocity(actions, time)
        for change in changes:
            taken = change(taken, actions, time)
        actions = actions - taken / steps
    return actions


def normal_logprob(values: Any, mean: Any, std: float) -> Any:
    """Return the log-density of each value under a normal distribution, nats."""
    return -0.5 * ((values - mean) / std) ** 2 - math.log(std) - 0.5 * _LOG_2_PI


def normal_entropy(std: float) -> float:
    """Return the differential entropy of a normal distribution, nats."""
    return math.log(std) + 0.5 * (1.0 + _LOG_2_PI)


def step_std(step: int, steps: int, noise_level: float) -> float:
    """Return the standard deviation of each number after a step.

    It is a * sqrt(t / (1 - t) / steps) for the noise level a at the time t = 1 - step / steps, with the time of the
    next step for 1 - t in the first one, where that is 0.
    """
    return noise_level * math.sqrt((steps - step) / max(step, 1) / steps)


def step_mean(actions: Any, velocity: Any, step: int, steps: int, noise_level: float) -> Any:
    """Return the mean of the less noisy actions after a step.

    Args:
        actions: The noisy actions before the step, (B, H, D).
        velocity: The flow's velocity there, (B, H, D).
        step: The number of the step, from 0.
        steps: The number of all steps.
        noise_level: The share of randomness a in the steps; 0 for the deterministic flow.

    Returns:
        The mean, (B, H, D).
    """
    time = 1.0 - step / steps
    noise = actions + (1.0 - time) * velocity  # as the model estimates it
    variance = step_std(step, steps, noise_level) ** 2
    return actions - velocity / steps - variance / (2.0 * time) * noise


def logprob_of_chain(velocity: Callable[[Any, float], Any], chain: Any, noise_level: float) -> Any:
    """Return the log-probability of the steps from noise to actions, given the noise, as a learner's weights have it.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time in (0, 1].
        chain: The noisy actions before and after each step, (B, K + 1, H, D), in the model's units: `replay["chain"]`
            of B acts or samples.
        noise_level: `replay["noise_level"]`.

    Returns:
        The log-probability of each number, summed over the steps, (B, H, D), nats. That of an act is of the rows and
        numbers that it returns: `[:, :execute, :action_dim]`.
    """
    steps = chain.shape[1] - 1
    total: Any = 0.0
    for step in range(steps):
        before = chain[:, step]
        mean = step_mean(before, velocity(before, 1.0 - step / steps), step, steps, noise_level)
        total = total + normal_logprob(chain[:, step + 1], mean, step_std(step, steps, noise_level))
    return total


def chain_entropy(steps: int, noise_level: float) -> float:
    """Return the entropy of one number of a chain, given the noise, nats: it depends on the noise level alone."""
    return sum(normal_entropy(step_std(step, steps, noise_level)) for step in range(steps))


class RandomSteps:
    """The random steps of those rows of a batch of which something is wanted; the others keep their velocity.

    Each row draws from its session's generator, so that neighbours do not matter. Arrays are torch tensors.
    """

    def __init__(
        self, rows: Sequence[Row], shape: tuple[int, int, int], noise_level: float, convert: Callable[[np.ndarray], Any]
    ) -> None:
        """Draw the noise of all steps.

        Args:
            rows: Those of the batch.
            shape: The number of steps K, rows and numbers of a chunk, (K, H, D).
            noise_level: As for `step_mean`.
            convert: Makes a tensor of an array, on the model's device.
        """
        self._wants = {i: row.want for i, row in enumerate(rows) if row.want}
        self._index, self._steps, self._level = list(self._wants), shape[0], noise_level
        self._draws = convert(np.stack([rows[i].noise(*shape) for i in self._index], axis=1))  # (K, E, H, D)
        self._chain: list[Any] = []  # noisy actions (E, H, D) at first, and after each step
        self._means: list[Any] = []  # of those after each step

    @classmethod
    def of(
        cls, rows: Sequence[Row], shape: tuple[int, int, int], noise_level: float, convert: Callable[[np.ndarray], Any]
    ) -> RandomSteps | None:
        """Return the random steps of a batch; None if there are none, in which case nothing is drawn."""
        return cls(rows, shape, noise_level, convert) if noise_level and any(row.want for row in rows) else None

    def change(self, velocity: Any, actions: Any, time: float) -> Any:
        """Return the velocity (B, H, D) of the next step, which leads the wanted rows to actions that are drawn."""
        step, before = len(self._means), actions[self._index]
        mean = step_mean(before, velocity[self._index], step, self._steps, self._level)
        drawn = mean + step_std(step, self._steps, self._level) * self._draws[step]
        change = (before - drawn) * self._steps
        self._chain = self._chain or [before]
        self._chain.append(before - change / self._steps)  # rounded as the actions will be
        self._means.append(mean)
        velocity = velocity.clone()
        velocity[self._index] = change
        return velocity

    def stated(self, execute: int | None, dim: int | None) -> dict[int, dict[str, Any]]:
        """Return what is wanted of rows, by their places in the batch, after the last step.

        Args:
            execute: The rows of a chunk that are used; None: all.
            dim: The numbers of a row that are used; None: all.
        """
        stds = [step_std(step, self._steps, self._level) for step in range(self._steps)]
        logprob = sum(map(normal_logprob, self._chain[1:], self._means, stds))[:, :execute, :dim].cpu().numpy()
        entropy = chain_entropy(self._steps, self._level) * logprob[0].size
        chains = [tensors.cpu().numpy() for tensors in self._chain]
        found: dict[int, dict[str, Any]] = {}
        for place, (i, want) in enumerate(self._wants.items()):
            replay = {"chain": np.stack([one[place] for one in chains]), "noise_level": self._level}
            said = {"logprob": logprob[place], "entropy": entropy, "replay": replay}
            found[i] = {name: said[name] for name in want}
        return found
