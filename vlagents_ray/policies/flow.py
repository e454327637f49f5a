"""Flow matching in random steps, so that an action chunk has a log-probability (Flow-SDE).

A flow's steps from noise to actions are deterministic, and the density of its actions is not known.
The stochastic differential equation with the same marginal distributions at each time (Song et al.
2021, arXiv 2011.13456) makes each step a normal distribution, and the steps a Markov chain whose
log-probability is a sum. Learners that fine-tune flows train with it: Flow-GRPO (arXiv 2505.05470),
whose noise schedule this is, and πRL (arXiv 2510.25889).

Flow time is openpi's: 1 is noise, 0 is the actions, and the velocity is noise minus actions. The
functions take arrays of any library, and are differentiable there.
"""

from __future__ import annotations

import abc
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vlagents_ray.policies.adapters import LoraAdapters
from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.base.model_inputs import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require

OFFERED = ("logprob", "entropy", "replay")  # of chunks from random steps
_LOG_2_PI = math.log(2 * math.pi)


Change = Callable[[Any, Any, float], Any]
"""The velocity (B, H, D), noisy actions (B, H, D) and flow time of a step -> the velocity that
it takes.
"""


def follow(velocity: Callable[[Any, float], Any], noise: Any, steps: int, *changes: Change) -> Any:
    """Integrate noise (B, H, D) to actions in Euler steps, from flow time 1 to 0.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time
            in (0, 1].
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


def step_std(step: int, steps: int, noise_level: float) -> float:
    """Return the standard deviation of each number after a step.

    It is a * sqrt(t / (1 - t) / steps) for the noise level a at the time t = 1 - step / steps, with
    the time of the next step for 1 - t in the first one, where that is 0.
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
    """Return the log-probability of the steps from noise to actions, given the noise, under a
    learner's weights.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time
            in (0, 1].
        chain: The noisy actions before and after each step, (B, K + 1, H, D), in the model's units:
            `replay["chain"]` of B acts or samples.
        noise_level: `replay["noise_level"]`.

    Returns:
        The log-probability of each number, summed over the steps, (B, H, D), nats. That of an act
        is of the rows and numbers that it returns: `[:, :execute, :action_dim]`.
    """
    steps = chain.shape[1] - 1
    total: Any = 0.0
    for step in range(steps):
        before = chain[:, step]
        mean = step_mean(before, velocity(before, 1.0 - step / steps), step, steps, noise_level)
        total = total + normal_logprob(chain[:, step + 1], mean, step_std(step, steps, noise_level))
    return total


def chain_entropy(steps: int, noise_level: float) -> float:
    """Return the entropy of one number of a chain, given the noise, nats: it depends on the
    noise level alone.
    """
    entropy = 0.0
    for step in range(steps):
        entropy += math.log(step_std(step, steps, noise_level)) + 0.5 * (1.0 + _LOG_2_PI)
    return entropy


class RandomSteps:
    """The random steps of the rows of a batch with requested values; the others keep their
    velocity.

    Each row draws from its session's generator, so that neighbours do not matter. Arrays are torch
    tensors.
    """

    def __init__(
        self,
        rows: Sequence[Row],
        shape: tuple[int, int, int],
        noise_level: float,
        convert: Callable[[np.ndarray], Any],
    ) -> None:
        """Draw the noise of all steps.

        Args:
            rows: Those of the batch.
            shape: The number of steps K, rows and numbers of a chunk, (K, H, D).
            noise_level: As for `step_mean`.
            convert: Makes a tensor of an array, on the model's device.
        """
        self._wants = {i: row.want for i, row in enumerate(rows) if row.want}
        self._steps, self._level = shape[0], noise_level
        # (K, E, H, D)
        self._draws = convert(np.stack([rows[i].noise(*shape) for i in self._wants], axis=1))
        # (E,); a list would be copied to the device at each step.
        self._index = convert(np.array(list(self._wants)))
        self._chain: list[Any] = []  # noisy actions (E, H, D) at first, and after each step
        self._means: list[Any] = []  # of those after each step

    @classmethod
    def for_rows(
        cls,
        rows: Sequence[Row],
        shape: tuple[int, int, int],
        noise_level: float,
        convert: Callable[[np.ndarray], Any],
    ) -> RandomSteps | None:
        """Return the random steps of a batch; None if there are none, in which case nothing is
        drawn.
        """
        if not noise_level or not any(row.want for row in rows):
            return None
        return cls(rows, shape, noise_level, convert)

    def change(self, velocity: Any, actions: Any, time: float) -> Any:
        """Return the velocity (B, H, D) of the next step, which moves the requested rows to
        drawn actions.
        """
        step, before = len(self._means), actions[self._index]
        mean = step_mean(before, velocity[self._index], step, self._steps, self._level)
        drawn = mean + step_std(step, self._steps, self._level) * self._draws[step]
        change = (before - drawn) * self._steps
        self._chain = self._chain or [before]
        self._chain.append(before - change / self._steps)  # rounded as the actions will be
        self._means.append(mean)
        return velocity.index_copy(0, self._index, change.to(velocity.dtype))

    def outputs(self, execute: int | None, dim: int | None) -> dict[int, dict[str, Any]]:
        """Return the outputs that rows request, by the index of the row, after the last step.

        Args:
            execute: How many rows of a chunk are used; None: all.
            dim: How many numbers of an action are the robot's; None: all.
        """
        stds = [step_std(step, self._steps, self._level) for step in range(self._steps)]
        total = sum(map(normal_logprob, self._chain[1:], self._means, stds))
        # A single copy from the device, for which this thread waits.
        *chain, all_logprobs = fetch(require("torch").stack([*self._chain, total]))
        logprobs = all_logprobs[:, :execute, :dim]
        entropy = chain_entropy(self._steps, self._level) * logprobs[0].size

        outputs: dict[int, dict[str, Any]] = {}
        for index, (row, want) in enumerate(self._wants.items()):
            row_chain = np.stack([actions[index] for actions in chain])
            available = {
                "logprob": logprobs[index],
                "entropy": entropy,
                "replay": {"chain": row_chain, "noise_level": self._level},
            }
            outputs[row] = {name: available[name] for name in want}
        return outputs


@dataclass(frozen=True, slots=True)
class Guide:
    """The plan that each row of a batch of chunks follows, as arrays of the library in which the
    model is written.
    """

    plan: Any  # (B, H, D) in the model's units, i.e. normalised; zeros where there is no plan
    frozen: Any  # (B, H, 1): 1.0 where a row will have been executed, else 0.0
    weight: Any  # (B, H, 1) in [0, 1]: how closely a later row follows

    @classmethod
    def for_rows(cls, rows: Sequence[Row], horizon: int, dim: int) -> Guide | None:
        """Return the guide of the rows' `delay` and `leftover`, in the model's units; None if no
        row has any.
        """
        if all(row.leftover is None for row in rows):
            return None

        plan = np.zeros((len(rows), horizon, dim), np.float32)
        frozen = np.zeros((len(rows), horizon, 1), np.float32)
        weight = np.zeros((len(rows), horizon, 1), np.float32)
        for i, row in enumerate(rows):
            if row.leftover is None:
                continue
            leftover = row.leftover[:horizon]
            delay = min(max(row.delay, 0), len(leftover))
            plan[i, : len(leftover), : leftover.shape[1]] = leftover
            frozen[i, :delay] = 1.0

            # The paper's soft mask: from about 1 after the frozen rows down to 0 where the plan
            # ends.
            later_rows = np.arange(delay, horizon, dtype=np.float32)
            share = np.clip((len(leftover) - later_rows) / (len(leftover) - delay + 1), 0.0, 1.0)
            weight[i, delay:, 0] = share * np.expm1(share) / np.expm1(1.0)
        return cls(plan, frozen, weight)

    def to(self, convert: Callable[[np.ndarray], Any]) -> Guide:
        """Convert the arrays to another library, or move them to another device."""
        return Guide(convert(self.plan), convert(self.frozen), convert(self.weight))

    def insert_frozen(self, noise: Any) -> Any:
        """Return noise (B, H, D) with the frozen rows of the plan in it, for a policy that was
        trained with prefixes.

        Such a policy reads these rows as actions, at flow time 0 (`FlowPasses.sample`'s `frozen`),
        and continues them without any correction (training-time action conditioning,
        https://arxiv.org/abs/2512.05964).
        """
        return self.frozen * self.plan + (1.0 - self.frozen) * noise

    def keep(self, velocity: Any, actions: Any, time: float) -> Any:
        """Return the velocity (B, H, D) that leaves the frozen rows as they are."""
        return (1.0 - self.frozen) * velocity

    def steer(
        self,
        velocity: Any,
        actions: Any,
        time: Any,
        *,
        noise: Any,
        steps: int,
        limit: float,
        lower: Callable[[Any, float], Any] = min,
    ) -> Any:
        """Return the velocity (B, H, D), corrected by the plan, at the noisy actions of a time of a
        flow from `noise`.

        The gain of the correction of a later row is at most `limit`, and at most the number of
        steps: with that, one step goes to the end. `lower` returns the smaller of two numbers, for
        libraries whose `time` is not a plain number.
        """
        spread = (1.0 - time) ** 2 + time**2
        gain = lower(spread / (time * (1.0 - time) + 1e-6), min(limit, float(steps)))
        pulled = velocity - gain * self.weight * (self.plan - (actions - time * velocity))
        return self.frozen * (noise - self.plan) + (1.0 - self.frozen) * pulled


class FlowPasses(abc.ABC):
    """The passes of a model: one over its inputs, and one for each step of the flow, or one for
    all steps.
    """

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Use the passes of a model, in their compiled form if there is one."""
        self.model = model
        self.adapters = LoraAdapters()  # of the policy
        # With the functions of its authors' own passes.
        self.module = sys.modules[type(model).__module__]
        self._compilation = compilation
        self._encode = compilation.core("encode", self.encode)
        self._velocity = compilation.core("velocity", self.velocity)
        self._flows: dict[int, Callable[..., Any]] = {}  # whole flows, by their steps
        self.by_row = False  # whether `velocity` takes a time for each row of a chunk, (B, H)

    def encode_images(self, images: Sequence[Any]) -> Sequence[Any]:
        """Return the input of `encode` for images (P, 3, H, W)."""
        return images

    @abc.abstractmethod
    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        """Return keys and values, or all else that `velocity` reads of inputs, and the mask (P, L)
        of the tokens that are there.

        Args:
            tokens: Of the instruction, (P, T) int64.
            mask: (P, T) bool, which of them are no padding.
            cameras: (P, N) bool, which of the images are there.
            state: (P, S).
            images: What `encode_images` returned for the N images.
        """

    @abc.abstractmethod
    def velocity(self, encoded: Any, present: Any, state: Any, actions: Any, times: Any) -> Any:
        """Return the velocity (B, H, D) of noisy actions (B, H, D).

        Args:
            encoded: The first result of `encode`, for B rows.
            present: The second one, the mask (B, L) of its tokens.
            state: (B, S).
            actions: (B, H, D).
            times: The flow times (B,), or (B, H) with `by_row`.
        """

    def chunks(
        self,
        rows: Sequence[Row],
        inputs: Sequence[Any],
        owners: Sequence[int],
        *,
        noise: np.ndarray,
        steps: int,
        config: Any,
        dim: int | None,
        convert: Callable[[np.ndarray], Any],
    ) -> tuple[np.ndarray, dict[int, dict[str, Any]]]:
        """Return actions (B, H, D) in the model's units, and the outputs that rows request, by the
        index of the row.

        Args:
            rows: Those of the batch, with plans in the model's units.
            inputs: The first five arguments of `sample`.
            owners: The observation of each row.
            noise: Drawn for each row, (B, H, D), before that of the steps, which only some rows
                draw.
            steps: The number of steps.
            config: The policy's `noise_level`, `guidance` and `execute`.
            dim: How many of the numbers are the robot's; None: all.
            convert: Makes a tensor of an array, on the model's device.
        """
        _, horizon, width = noise.shape
        start = convert(noise)
        changes: list[Change] = []

        guide = Guide.for_rows(rows, horizon, width)
        if guide is not None:
            converted = guide.to(convert)
            changes.append(
                partial(converted.steer, noise=start, steps=steps, limit=config.guidance)
            )
        random = RandomSteps.for_rows(rows, (steps, horizon, width), config.noise_level, convert)
        if random is not None:
            changes.append(random.change)

        fingerprints = [row.adapter for row in rows]
        flow = self.sample(
            *inputs,
            noise=start,
            owners=owners,
            steps=steps,
            changes=changes,
            fingerprints=fingerprints if any(fingerprints) else (),
        )
        outputs = {} if random is None else random.outputs(config.execute, dim)
        return fetch(flow), outputs

    def sample(
        self,
        images: Sequence[Any],
        cameras: Sequence[Any],
        tokens: Any,
        mask: Any,
        state: Any = None,
        *,
        noise: Any,
        owners: Sequence[int],
        steps: int,
        changes: Sequence[Change] = (),
        fingerprints: Sequence[str] = (),
        frozen: Any = None,
        states: Any = None,
        state_masks: Any = None,
    ) -> Any:
        """Return actions (B, H, D).

        Args:
            images: Of P observations, (P, 3, H, W) for each of N cameras.
            cameras: Which of them are there, (P,) bool for each camera.
            tokens: See `encode`.
            mask: See `encode`.
            state: See `encode`; None for a model that has it in its prompt.
            noise: (B, H, D).
            owners: The observation of each row.
            steps: Of the flow.
            changes: See `follow`.
            fingerprints: The adapter of each row, see `Row.adapter`; empty: none has one.
            frozen: With `by_row`, which rows of the chunks are actions already, at time 0: (B, H,
                1), 1.0 or 0.0.
            states: Of a memory, from LeRobot's π0.5 after 0.6.1, and None, as models with a memory
                are refused.
            state_masks: As `states`.
        """
        torch = require("torch")
        observations = len(mask)
        # The adapter of an observation is that of the first of its rows.
        encoding_adapters: list[str] = []
        if fingerprints:
            first_rows = [list(owners).index(owner) for owner in range(observations)]
            encoding_adapters = [fingerprints[row] for row in first_rows]
        if state is None:
            state = mask[:, :0].float()
        with self.adapters.rows(encoding_adapters):
            encoded, present = self._encode(
                tokens, mask, torch.stack(list(cameras), 1), state, *self.encode_images(images)
            )

        if list(owners) != list(range(observations)):
            index = torch.tensor(owners).to(mask.device, non_blocking=True)
            encoded, present, state = encoded[index], present[index], state[index]

        changed = partial(self._flow, steps, changes, frozen)
        flow = changed if changes else self._whole_flow(steps)
        with self.adapters.rows(fingerprints):
            return flow(encoded, present, state, noise)

    def _whole_flow(self, steps: int) -> Callable[..., Any]:
        """Return the flow of all steps without changes, which is one core."""
        if steps not in self._flows:
            function = partial(self._flow, steps, (), None)
            self._flows[steps] = self._compilation.core("flow", function, parts=[self._velocity])
        return self._flows[steps]

    def _flow(
        self,
        steps: int,
        changes: Sequence[Change],
        frozen: Any,
        encoded: Any,
        present: Any,
        state: Any,
        noise: Any,
    ) -> Any:
        """Return actions (B, H, D): without changes, whose values differ for each batch, all
        steps are one core.
        """
        float32 = require("torch").float32

        def velocity(actions: Any, time: float) -> Any:
            """Return the velocity at one time, which is 0 for frozen rows."""
            times = actions.new_full(actions.shape[: 2 if self.by_row else 1], time, dtype=float32)
            if frozen is not None:
                times = times * (1.0 - frozen[..., 0])
            return self._velocity(encoded, present, state, actions, times)

        return follow(velocity, noise, steps, *changes)
