"""Flow matching with random steps, which gives an action chunk a log-probability (Flow-SDE).

The steps of a flow from noise to actions are deterministic, and the density of its actions is not
known. A stochastic differential equation with the same marginal distributions at each time exists
(Song et al. 2021, arXiv 2011.13456). With this equation, each step is drawn from a normal
distribution, and the steps are a Markov chain whose log-probability is a sum. Learners that
fine-tune flows use this chain: Flow-GRPO (arXiv 2505.05470), whose noise schedule is used here, and
πRL (arXiv 2510.25889).

Flow time follows openpi: 1 is noise, 0 is the actions, and the velocity is noise minus actions. The
functions accept arrays of any library, which can differentiate them.
"""

from __future__ import annotations

import abc
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.policies.base.accelerator import fetch
from vlagents_ray.policies.base.model_inputs import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require

OFFERED = ("logprob", "entropy", "replay")  # outputs of a chunk that was computed in random steps
_LOG_2_PI = math.log(2 * math.pi)


Change = Callable[[Any, Any, float], Any]
"""A change of a step: velocity (B, H, D), noisy actions (B, H, D) and flow time -> new velocity."""

Velocity = Callable[[Any], Any]
"""The velocity of a flow at one time: noisy actions (B, H, D) -> velocity (B, H, D)."""

Guidance = Callable[[Velocity, Any, float], Any]
"""Guides a step: velocity, noisy actions (B, H, D) and flow time -> guided velocity (B, H, D)."""

PullBack = Callable[[Velocity, Any, Any, Callable[[Any], Any]], tuple[Any, Any]]
"""Computes a correction of noisy actions, see `pull_back`."""


def pull_back(
    velocity: Velocity, actions: Any, time: float, error: Callable[[Any], Any]
) -> tuple[Any, Any]:
    """Multiply an error of the expected actions by the transposed Jacobian of the flow.

    The expected actions at a flow time are `actions - time * velocity(actions)`. An error of some
    rows thereby corrects all rows that the flow relates to them. This is for torch, outside of its
    inference mode.

    Args:
        velocity: The velocity of the flow.
        actions: The noisy actions, (B, H, D).
        time: The flow time.
        error: Returns the error (B, H, D) of expected actions (B, H, D).

    Returns:
        The velocity (B, H, D), and the correction of the noisy actions (B, H, D).
    """
    torch = require("torch")
    with torch.enable_grad():
        noisy = actions.detach().requires_grad_()
        taken = velocity(noisy)
        expected = noisy - time * taken
        [correction] = torch.autograd.grad(expected, noisy, error(expected.detach()))
    return taken.detach(), correction


def follow(velocity: Callable[[Any, float], Any], noise: Any, steps: int, *changes: Change) -> Any:
    """Integrate noise (B, H, D) to actions in Euler steps, from flow time 1 to 0.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time
            in (0, 1].
        noise: The actions at time 1.
        steps: The number of steps.
        changes: Functions that are applied to the velocity of each step, in this order.
    """

    def velocity_of_step(actions: Any, step: int) -> Any:
        return velocity(actions, 1.0 - step / steps)

    return follow_steps(velocity_of_step, noise, steps, *changes)


def follow_steps(
    velocity: Callable[[Any, int], Any], noise: Any, steps: int, *changes: Change
) -> Any:
    """Integrate noise (B, H, D) to actions, as `follow` does.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and the index of
            a step, from 0.
        noise: The actions at time 1.
        steps: The number of steps.
        changes: Functions that are applied to the velocity of each step, in this order.
    """
    actions = noise
    for step in range(steps):
        taken = velocity(actions, step)
        for change in changes:
            taken = change(taken, actions, 1.0 - step / steps)
        actions = actions - taken / steps
    return actions


def normal_logprob(values: Any, mean: Any, std: float) -> Any:
    """Return the log-density of each value under a normal distribution, nats."""
    return -0.5 * ((values - mean) / std) ** 2 - math.log(std) - 0.5 * _LOG_2_PI


def step_std(step: int, steps: int, noise_level: float) -> float:
    """Return the standard deviation of each value after a step.

    For the noise level a and the time t = 1 - step / steps, it is a * sqrt(t / (1 - t) / steps). In
    the first step, 1 - t would be 0, so the value of 1 - t from the second step is used.
    """
    return noise_level * math.sqrt((steps - step) / max(step, 1) / steps)


def step_mean(actions: Any, velocity: Any, step: int, steps: int, noise_level: float) -> Any:
    """Return the mean of the less noisy actions after a step.

    Args:
        actions: The noisy actions before the step, (B, H, D).
        velocity: The flow's velocity at these actions, (B, H, D).
        step: The index of the step, from 0.
        steps: The number of steps.
        noise_level: The randomness of the steps; 0 for the deterministic flow.

    Returns:
        The mean, (B, H, D).
    """
    time = 1.0 - step / steps
    noise = actions + (1.0 - time) * velocity  # estimates of the model
    variance = step_std(step, steps, noise_level) ** 2
    return actions - velocity / steps - variance / (2.0 * time) * noise


def logprob_of_chain(velocity: Callable[[Any, float], Any], chain: Any, noise_level: float) -> Any:
    """Return the log-probability of a chain of steps under a learner's weights, given the noise.

    Args:
        velocity: Returns the flow's velocity (B, H, D) at noisy actions (B, H, D) and a flow time
            in (0, 1].
        chain: The noisy actions before and after each step, (B, K + 1, H, D), in the model's units:
            the values of `replay["chain"]` of B answers or samples.
        noise_level: `replay["noise_level"]`.

    Returns:
        The log-probability of each value, summed over the steps, (B, H, D), nats. The rows and
        values that an answer returns are `[:, :execute, :action_dim]`.
    """
    steps = chain.shape[1] - 1
    total: Any = 0.0
    for step in range(steps):
        before = chain[:, step]
        mean = step_mean(before, velocity(before, 1.0 - step / steps), step, steps, noise_level)
        total = total + normal_logprob(chain[:, step + 1], mean, step_std(step, steps, noise_level))
    return total


def chain_entropy(steps: int, noise_level: float) -> float:
    """Return the entropy of one value of a chain, given the noise, nats.

    It depends only on the number of steps and on the noise level.
    """
    entropy = 0.0
    for step in range(steps):
        entropy += math.log(step_std(step, steps, noise_level)) + 0.5 * (1.0 + _LOG_2_PI)
    return entropy


class RandomSteps:
    """The random steps of the rows of a batch for which outputs are requested.

    The other rows keep their velocity. Each row draws from the generator of its session, so that
    the other rows of a batch have no influence. Arrays are torch tensors.
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
            rows: The rows of the batch.
            shape: The number of steps, the number of rows of a chunk, and the number of values of a
                row, (K, H, D).
            noise_level: As for `step_mean`.
            convert: Makes a tensor on the model's device from an array.
        """
        self._wants = {i: row.want for i, row in enumerate(rows) if row.want}
        self._steps, self._level = shape[0], noise_level
        # The noise of the E requested rows, (K, E, H, D).
        self._draws = convert(np.stack([rows[i].noise(*shape) for i in self._wants], axis=1))
        # The indices of these rows, (E,). A list would be copied to the device in each step.
        self._index = convert(np.array(list(self._wants)))
        # Noisy actions (E, H, D) before the first step and after each step.
        self._chain: list[Any] = []
        self._means: list[Any] = []  # mean of the noisy actions after each step

    @classmethod
    def for_rows(
        cls,
        rows: Sequence[Row],
        shape: tuple[int, int, int],
        noise_level: float,
        convert: Callable[[np.ndarray], Any],
    ) -> RandomSteps | None:
        """Return the random steps of a batch.

        Returns:
            The steps; None if no row requests outputs, in which case nothing is drawn.
        """
        if not noise_level or not any(row.want for row in rows):
            return None
        return cls(rows, shape, noise_level, convert)

    def change(self, velocity: Any, actions: Any, time: float) -> Any:
        """Return the velocity (B, H, D) with which the next step reaches the drawn actions."""
        step, before = len(self._means), actions[self._index]
        mean = step_mean(before, velocity[self._index], step, self._steps, self._level)
        drawn = mean + step_std(step, self._steps, self._level) * self._draws[step]
        change = (before - drawn) * self._steps
        self._chain = self._chain or [before]
        # This repeats the computation of `follow`, so that the rounding is the same.
        self._chain.append(before - change / self._steps)
        self._means.append(mean)
        return velocity.index_copy(0, self._index, change.to(velocity.dtype))

    def outputs(self, execute: int | None, dim: int | None) -> dict[int, dict[str, Any]]:
        """Return the requested outputs after the last step.

        Args:
            execute: The number of rows of a chunk that are used; None uses all.
            dim: The number of values of an action that are the robot's; None uses all.

        Returns:
            The index of the row -> name of the output -> value.
        """
        stds = [step_std(step, self._steps, self._level) for step in range(self._steps)]
        total = sum(map(normal_logprob, self._chain[1:], self._means, stds))
        # Copy all values from the device at once, since this thread waits for each copy.
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
    """The plan that each chunk of a batch follows, as arrays of the model's library."""

    plan: Any  # (B, H, D) in the model's normalised units; zeros where there is no plan
    frozen: Any  # (B, H, 1), 1.0 for rows that will have been executed, otherwise 0.0
    weight: Any  # (B, H, 1) in [0, 1], how closely a later row follows the plan

    @classmethod
    def for_rows(cls, rows: Sequence[Row], horizon: int, dim: int) -> Guide | None:
        """Return the guide that follows from the `delay` and the `leftover` of rows in the model's
        units.

        Without a delay, no row of the plan is executed before the chunk arrives. The chunk is then
        computed as without a plan, since the new observation is better than the old plan.

        Returns:
            The guide; None if no row has both a leftover plan and a delay.
        """
        delays = [0 if row.leftover is None else min(row.delay, len(row.leftover)) for row in rows]
        if max(delays, default=0) <= 0:
            return None

        plan = np.zeros((len(rows), horizon, dim), np.float32)
        frozen = np.zeros((len(rows), horizon, 1), np.float32)
        weight = np.zeros((len(rows), horizon, 1), np.float32)
        for i, (row, planned_delay) in enumerate(zip(rows, delays, strict=True)):
            if row.leftover is None or planned_delay <= 0:
                continue
            leftover = row.leftover[:horizon]
            delay = min(planned_delay, horizon)
            plan[i, : len(leftover), : leftover.shape[1]] = leftover
            frozen[i, :delay] = 1.0

            # The soft mask of real-time chunking: it falls from about 1 after the frozen rows to 0
            # where the plan ends.
            later_rows = np.arange(delay, horizon, dtype=np.float32)
            share = np.clip((len(leftover) - later_rows) / (len(leftover) - delay + 1), 0.0, 1.0)
            weight[i, delay:, 0] = share * np.expm1(share) / np.expm1(1.0)
        return cls(plan, frozen, weight)

    def to(self, convert: Callable[[np.ndarray], Any]) -> Guide:
        """Convert the arrays to another library, or move them to another device."""
        return Guide(convert(self.plan), convert(self.frozen), convert(self.weight))

    def insert_frozen(self, noise: Any) -> Any:
        """Return noise (B, H, D) in which rows of the plan replace the frozen rows.

        This is for policies that were trained with prefixes. Such policies read these rows as
        actions, at flow time 0 (`frozen` of `FlowPasses.sample`), and continue them without a
        correction (training-time action conditioning, https://arxiv.org/abs/2512.05964).
        """
        return self.frozen * self.plan + (1.0 - self.frozen) * noise

    def keep(self, velocity: Any, actions: Any, time: float) -> Any:
        """Return the velocity (B, H, D), which is 0 for the frozen rows."""
        return (1.0 - self.frozen) * velocity

    def steer(
        self,
        velocity: Velocity,
        actions: Any,
        time: Any,
        *,
        limit: float,
        lower: Callable[[Any, float], Any] = min,
        pull: PullBack = pull_back,
    ) -> Any:
        """Return the velocity (B, H, D), guided towards the plan.

        This is real-time chunking (https://arxiv.org/abs/2506.07339, equations 2 to 4). The
        difference between the plan and the expected actions is multiplied by the weights of the
        rows and by the transposed Jacobian of the flow, through which the frozen rows also move the
        later ones. Chunks without a plan keep their velocity.

        Args:
            velocity: The velocity of the flow at this time.
            actions: The noisy actions, (B, H, D).
            time: The flow time.
            limit: The largest gain of the correction.
            lower: Returns the smaller of two numbers, for libraries whose `time` is not a plain
                number.
            pull: Multiplies by the Jacobian, as `pull_back` does for torch.
        """

        def error(expected: Any) -> Any:
            return (self.frozen + self.weight) * (self.plan - expected)

        taken, correction = pull(velocity, actions, time, error)
        spread = (1.0 - time) ** 2 + time**2
        gain = lower(spread / (time * (1.0 - time) + 1e-6), limit)
        return taken - gain * correction


class FlowPasses(abc.ABC):
    """The forward passes of a model: one pass over its inputs, and one pass for each step of the
    flow.

    All steps may also be compiled as one pass.
    """

    # Whether each layer is compiled as a separate region, see `Compilation.region`.
    by_regions: ClassVar[bool] = False

    def __init__(self, model: Any, compilation: Compilation) -> None:
        """Create the forward passes of a model, compiled where possible."""
        self.model = model
        # The module that defines the model, with the functions that its authors use in their
        # forward passes.
        self.module = sys.modules[type(model).__module__]
        self._compilation = compilation
        regions = self.by_regions
        self._encode = compilation.core("encode", self.encode, by_regions=regions)
        self._velocity = compilation.core("velocity", self._step, by_regions=regions)
        self._flows: dict[int, Callable[..., Any]] = {}  # number of steps -> core of the whole flow
        self.by_row = False  # whether `velocity` accepts a time for each row of a chunk, (B, H)
        # Whether the model was trained to begin chunks with given rows. It is then not guided.
        self.has_prefixes = False

    def encode_images(self, images: Sequence[Any]) -> Sequence[Any]:
        """Return the input of `encode` for images (P, 3, H, W)."""
        return images

    @abc.abstractmethod
    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        """Encode the inputs of P observations.

        Args:
            tokens: The tokens of the instruction, (P, T) int64.
            mask: Whether each token is a token of the instruction, not padding, (P, T) bool.
            cameras: Whether each image is present, (P, N) bool.
            state: The state vector, (P, S).
            images: The results of `encode_images` for the N images.

        Returns:
            The keys and values, or other features of the inputs that `velocity` reads; and the mask
            of the tokens that are present, (P, L).
        """

    def constants(self, encoded: Any, present: Any, state: Any, horizon: int) -> tuple[Any, ...]:
        """Compute the inputs that are the same in all steps of a flow.

        Args:
            encoded: The first result of `encode`, for B rows.
            present: The second result of `encode`, the mask (B, L) of the tokens.
            state: The state vector, (B, S).
            horizon: The number of rows of a chunk, H.

        Returns:
            Tensors whose first dimension is B, for `velocity`. By default, these are the arguments.
        """
        return encoded, present, state

    def at_times(self, times: Any) -> Any:
        """Compute the features of the flow times of all steps of a flow.

        Args:
            times: The flow times of the K steps, (B, K); or (B, K, H) with `by_row`. Without
                `by_row` they are the same for all rows.

        Returns:
            A tensor (B, K, …). Step k receives `[:, k]`. By default, these are the times.
        """
        return times

    def with_prefixes(self, encoded: Any, actions: Any, frozen: Any) -> Any:
        """Return the encoded inputs of chunks that begin with given rows.

        By default, these are the encoded inputs: the model then reads the given rows from the noisy
        actions, at flow time 0 (`by_row`).

        Args:
            encoded: The first result of `encode`, for B rows.
            actions: Chunks whose first rows are given, (B, H, D).
            frozen: 1.0 for given rows, 0.0 for other rows, (B, H, 1).
        """
        return encoded

    @abc.abstractmethod
    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        """Return the velocity (B, H, D) of noisy actions (B, H, D).

        Args:
            constants: The result of `constants`.
            actions: The noisy actions, (B, H, D).
            times: The result of `at_times` for this step. By default, these are the flow times
                (B,), or (B, H) with `by_row`.
        """

    def _step(self, *tensors: Any) -> Any:
        """Return the velocity. This is the core of one step, with tensors as its only arguments."""
        *constants, actions, times = tensors
        return self.velocity(constants, actions, times)

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
        """Compute the chunks of a batch, with plans and random steps.

        Args:
            rows: The rows of the batch, with plans in the model's units.
            inputs: The first five arguments of `sample`.
            owners: The index of the observation of each row.
            noise: The noise of each row, (B, H, D). It is drawn before the noise of the steps,
                which is drawn for only some of the rows.
            steps: The number of steps.
            config: The policy's settings, with `noise_level`, `guidance` and `execute`.
            dim: The number of values of an action that are the robot's; None uses all.
            convert: Makes a tensor on the model's device from an array.

        Returns:
            Actions (B, H, D) in the model's units, and the requested outputs by the index of the
            row.
        """
        _, horizon, width = noise.shape
        start = convert(noise)
        changes: list[Change] = []

        guide = Guide.for_rows(rows, horizon, width)
        guidance: Guidance | None = None
        frozen = None
        if guide is not None and self.has_prefixes:
            prefixes = guide.to(convert)
            start, frozen = prefixes.insert_frozen(start), prefixes.frozen
            changes.append(prefixes.keep)
        elif guide is not None:
            # A single step with the gain `steps` already reaches the plan.
            limit = min(config.guidance, float(steps))
            guidance = partial(guide.to(convert).steer, limit=limit)
        random = RandomSteps.for_rows(rows, (steps, horizon, width), config.noise_level, convert)
        if random is not None:
            changes.append(random.change)

        flow = self.sample(
            *inputs,
            noise=start,
            owners=owners,
            steps=steps,
            changes=changes,
            guidance=guidance,
            frozen=frozen,
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
        guidance: Guidance | None = None,
        frozen: Any = None,
        states: Any = None,
        state_masks: Any = None,
    ) -> Any:
        """Return actions (B, H, D).

        A guided flow is not compiled, since its steps need the gradient of the network.

        Args:
            images: The images of P observations, (P, 3, H, W) for each of N cameras.
            cameras: Whether each image is present, (P,) bool for each camera.
            tokens: See `encode`.
            mask: See `encode`.
            state: See `encode`; None for a model whose prompt contains the state.
            noise: (B, H, D).
            owners: The index of the observation of each row.
            steps: The number of steps of the flow.
            changes: See `follow`.
            guidance: The guidance of each step, before the changes; None if no chunk is guided.
            frozen: 1.0 for the rows of chunks that are already actions, and 0.0 for other rows, (B,
                H, 1); None if there are no such rows. With `by_row`, their flow time is 0.
            states: The states of a memory, an argument that LeRobot's π0.5 passes since 0.6.1. It
                is None, since models with a memory are rejected.
            state_masks: As `states`.
        """
        torch = require("torch")
        if state is None:
            state = mask[:, :0].float()
        encoded, present = self._encode(
            tokens, mask, torch.stack(list(cameras), 1), state, *self.encode_images(images)
        )

        if list(owners) != list(range(len(mask))):
            index = torch.tensor(owners).to(mask.device, non_blocking=True)
            encoded, present, state = encoded[index], present[index], state[index]

        if frozen is not None:
            encoded = self.with_prefixes(encoded, noise, frozen)

        if guidance is not None:
            return self._guided_flow(steps, changes, guidance, encoded, present, state, noise)
        changed = partial(self._flow, steps, changes, frozen if self.by_row else None)
        flow = changed if changes else self._whole_flow(steps)
        return flow(encoded, present, state, noise)

    def _guided_flow(
        self, steps: int, changes: Sequence[Change], guidance: Guidance, *inputs: Any
    ) -> Any:
        """Return actions (B, H, D), see `_flow`.

        Policies run in torch's inference mode, whose tensors cannot be differentiated. The steps
        therefore run outside of it, on copies of their inputs.
        """
        torch = require("torch")
        with torch.inference_mode(False), torch.no_grad():
            copies = [tensor.clone() for tensor in inputs]
            return self._flow(steps, changes, None, *copies, guidance=guidance)

    def _whole_flow(self, steps: int) -> Callable[..., Any]:
        """Return the core of the whole flow, without changes of the velocity."""
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
        *,
        guidance: Guidance | None = None,
    ) -> Any:
        """Return actions (B, H, D).

        Without changes, this function is a core. The values of changes differ for each batch.
        """
        torch = require("torch")
        constants = self.constants(encoded, present, state, noise.shape[1])

        shape = noise.shape[: 2 if self.by_row else 1]
        times_of_steps = []
        for step in range(steps):
            times = noise.new_full(shape, 1.0 - step / steps, dtype=torch.float32)
            # Frozen rows are already actions, at flow time 0.
            times_of_steps.append(times if frozen is None else times * (1.0 - frozen[..., 0]))
        at_times = self.at_times(torch.stack(times_of_steps, 1))

        def velocity(actions: Any, step: int) -> Any:
            """Return the velocity at the flow time of a step."""
            if guidance is None:
                return self._velocity(*constants, actions, at_times[:, step])

            def at_step(noisy: Any) -> Any:
                return self._step(*constants, noisy, at_times[:, step])

            return guidance(at_step, actions, 1.0 - step / steps)

        return follow_steps(velocity, noise, steps, *changes)
