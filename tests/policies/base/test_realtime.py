"""Real-time chunking, tested on the flow of normal distributions, whose velocity, Jacobian and
posterior are known in closed form.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray.policies.base.model_inputs import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import FlowPasses, Guide, follow

HORIZON, DIM, STEPS = 8, 3, 10
VALUES = HORIZON * DIM
SETTINGS = SimpleNamespace(guidance=5.0, noise_level=0.0, execute=None)


def row(leftover: np.ndarray | None = None, delay: int = 0, seed: int = 0) -> Row:
    return Row((), "", np.random.default_rng(seed), leftover, delay)


def plan(length: int = 6) -> np.ndarray:
    return np.linspace(-1, 1, length * DIM, dtype=np.float32).reshape(length, DIM)


def smooth() -> np.ndarray:
    """Return a covariance (N, N) of chunks whose consecutive rows are alike."""
    rows = np.arange(HORIZON)
    return np.kron(0.8 ** np.abs(rows[:, None] - rows), np.eye(DIM)).astype(np.float32)


def denoiser(covariance: Any, time: float) -> Any:
    """Return the matrix (N, N) that maps noisy actions to the mean of the actions.

    It is also the flow's Jacobian, and symmetric.
    """
    spread = (1 - time) ** 2 * covariance + time**2 * np.eye(len(covariance))
    return (1 - time) * covariance @ np.linalg.inv(spread)


class Normal(FlowPasses):
    """The flow of normal distributions without a mean. The covariance is the encoded input."""

    dtype = "float32"

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        return state.unflatten(1, (VALUES, VALUES)), mask

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        import torch

        covariance, time = constants[0], times[:, None, None]
        spread = (1 - time) ** 2 * covariance + time**2 * torch.eye(VALUES)
        matrix = (1 - time) * covariance @ torch.linalg.inv(spread)
        kind = getattr(torch, self.dtype)
        noisy = actions.flatten(1).to(kind)
        expected = (matrix.to(kind) @ noisy[..., None])[..., 0]
        velocity = (noisy - expected) / times[:, None].to(kind)
        return velocity.float().unflatten(1, (HORIZON, DIM))


def chunks(*rows: Row, steps: int = STEPS, dtype: str = "float32", passes: Any = None) -> Any:
    """Return (B, H, D) actions, computed as in a policy."""
    import torch

    passes = passes or Normal(torch.nn.Identity(), Compilation(False))
    passes.dtype = dtype
    count = len(rows)
    present = torch.ones(count, 1, dtype=torch.bool)
    inputs = [
        [torch.zeros(count, 3, 8, 8)],
        [present[:, 0]],
        torch.zeros(count, 1, dtype=torch.long),
        present,
        torch.from_numpy(smooth()).flatten().expand(count, -1),
    ]
    noise = np.stack([one.noise(HORIZON, DIM) for one in rows])
    actions, _ = passes.chunks(
        rows,
        inputs,
        range(count),
        noise=noise,
        steps=steps,
        config=SETTINGS,
        dim=None,
        convert=torch.from_numpy,
    )
    return actions


def test_without_a_plan_or_a_delay_there_is_no_guide() -> None:
    rows = [row(), row(plan(), 0), row(plan()[:0], 3), row(plan(), -1)]
    assert Guide.for_rows(rows, HORIZON, DIM) is None
    assert Guide.for_rows([], HORIZON, DIM) is None


@pytest.mark.torch
def test_without_a_delay_a_chunk_is_bit_identical_to_one_without_a_plan() -> None:
    np.testing.assert_array_equal(chunks(row(plan(), 0)), chunks(row()))
    together = chunks(row(plan(), 0, 1), row(plan(), 3, 2), row(seed=3))
    unguided = chunks(row(seed=1), row(seed=2), row(seed=3))
    np.testing.assert_array_equal(together[[0, 2]], unguided[[0, 2]])
    assert (together[1] != unguided[1]).all()


@pytest.mark.torch
@pytest.mark.parametrize("delay", [1, 3, 6])
def test_rows_within_the_delay_come_close_to_the_plan(delay: int) -> None:
    distance = np.abs(chunks(row(plan(), delay), steps=50)[0, :delay] - plan()[:delay])
    without = np.abs(chunks(row(), steps=50)[0, :delay] - plan()[:delay])
    assert distance.max() < 0.1 * without.max()


def test_weights_fall_from_the_frozen_rows_to_the_end_of_the_plan() -> None:
    guide = Guide.for_rows([row(plan(6), 2), row(plan(2), 5), row(plan(20), 20)], HORIZON, DIM)
    assert guide is not None
    assert guide.frozen.sum(1)[:, 0].tolist() == [2, 2, HORIZON]
    weights = (guide.frozen + guide.weight)[0, :, 0]
    assert (weights[:2] == 1).all()
    assert (np.diff(weights[1:7]) < 0).all()
    assert (weights[6:] == 0).all()
    np.testing.assert_array_equal(guide.plan[2], plan(20)[:HORIZON])


@pytest.mark.torch
@pytest.mark.parametrize("steps", [1, 2, 10])
def test_few_steps_do_not_overshoot(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The gain is at most the number of steps, since one step with that gain reaches the plan."""
    monkeypatch.setattr(SETTINGS, "guidance", 100.0)
    left = np.zeros((HORIZON, DIM), np.float32)
    guided, free = chunks(row(left, HORIZON), steps=steps), chunks(row(), steps=steps)
    assert (np.abs(guided) <= np.abs(free).max()).all()


@pytest.mark.torch
@pytest.mark.parametrize("dtype", ["float32", "bfloat16", "float16"])
@pytest.mark.parametrize("context", ["inference_mode", "no_grad", None])
def test_contexts_and_types_of_a_server_do_not_matter(context: str | None, dtype: str) -> None:
    import torch

    expected = chunks(row(plan(), 3))
    within: AbstractContextManager[object] = (
        nullcontext() if context is None else getattr(torch, context)()
    )
    with within:
        actions = chunks(row(plan(), 3), dtype=dtype)
        assert torch.is_inference_mode_enabled() == (context == "inference_mode")
    # bfloat16 keeps 8 bits, and errors of the ten steps add up.
    tolerance = {"float32": 0, "bfloat16": 0.1, "float16": 0.01}[dtype]
    np.testing.assert_allclose(actions, expected, atol=tolerance)


@pytest.mark.torch
def test_a_guided_flow_retains_nothing() -> None:
    import torch

    def tensors() -> int:
        gc.collect()
        return sum(issubclass(type(value), torch.Tensor) for value in gc.get_objects())

    passes = Normal(torch.nn.Identity(), Compilation(False))
    with torch.inference_mode():
        chunks(row(plan(), 3), passes=passes)
        before = tensors()
        for _ in range(3):
            chunks(row(plan(), 3), passes=passes)
        assert tensors() == before


@pytest.mark.torch
def test_weights_of_inference_mode_can_be_differentiated_after_a_push() -> None:
    import torch

    from vlagents_ray.weights.trainable import set_values

    module = torch.nn.Linear(2, 1, bias=False).requires_grad_(False)
    with torch.inference_mode():
        set_values(module, {"weight": torch.tensor([[2.0, 3.0]])})
    values = torch.ones(1, 2, requires_grad=True)
    [gradient] = torch.autograd.grad(module(values), values)
    assert gradient.tolist() == [[2.0, 3.0]]


@pytest.mark.torch
def test_a_guided_flow_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    def compiled(*_: Any) -> Any:
        raise AssertionError("a compiled core has no gradient")

    passes = Normal(torch.nn.Identity(), Compilation(False))
    monkeypatch.setattr(passes, "_velocity", compiled)
    np.testing.assert_array_equal(chunks(row(plan(), 3), passes=passes), chunks(row(plan(), 3)))


@pytest.mark.torch
@settings(deadline=None, max_examples=40)
@given(
    plans=st.lists(
        st.tuples(st.integers(0, HORIZON + 2), st.integers(0, HORIZON + 2)), min_size=1, max_size=5
    )
)
def test_each_chunk_of_a_batch_is_as_alone(plans: list[tuple[int, int]]) -> None:
    together = chunks(*(row(plan(n), delay, i) for i, (n, delay) in enumerate(plans)))
    for i, (n, delay) in enumerate(plans):
        np.testing.assert_allclose(together[i], chunks(row(plan(n), delay, i))[0], atol=1e-5)


def normal_flow(covariance: np.ndarray, guide: Guide, noise: np.ndarray, steps: int) -> np.ndarray:
    """Return the chunk (H, D) of a guided flow in float64, with an unlimited gain."""
    import torch

    to_tensor = torch.from_numpy
    guide = guide.to(to_tensor)
    shape = noise.shape

    def guided(actions: Any, time: float) -> Any:
        matrix = to_tensor(denoiser(covariance, time))

        def velocity(noisy: Any) -> Any:
            values = noisy.flatten()
            return ((values - matrix @ values) / time).reshape(shape)

        return guide.steer(velocity, actions, time, limit=float(steps))

    return np.asarray(follow(guided, to_tensor(noise), steps))


@st.composite
def coupled(draw: st.DrawFn, most: float) -> tuple[np.ndarray, np.ndarray, int, int, int]:
    """Return normal distributions whose frozen values are independent, with variance 1.

    Returns:
        The covariance (N, N); the matrix (N - K, K) that maps K frozen values to the mean of the
        later ones, whose largest singular value is at most `most`; the numbers of rows, of values
        of a row and of frozen rows.
    """
    horizon, dim = draw(st.integers(2, 10)), draw(st.integers(1, 4))
    frozen = draw(st.integers(1, horizon - 1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    known, later = frozen * dim, (horizon - frozen) * dim
    effect = rng.standard_normal((later, known))
    effect *= draw(st.floats(0.2, 1.0)) * most / np.linalg.norm(effect, 2)
    mixed = rng.standard_normal((later, later)) / np.sqrt(later)
    rest = draw(st.floats(0.1, 1.0)) * mixed @ mixed.T + 0.05 * np.eye(later)
    covariance = np.block([[np.eye(known), effect.T], [effect, effect @ effect.T + rest]])
    return covariance, effect, horizon, dim, frozen


def error_of_later_rows(
    covariance: np.ndarray, effect: np.ndarray, shape: tuple[int, int], frozen: int, steps: int
) -> float:
    """Return the distance of the later rows from the mean of their posterior, given the frozen
    ones, as a share of the way from their prior's mean.
    """
    horizon, dim = shape
    left = np.random.default_rng(0).standard_normal((1, horizon, dim))
    flags = (np.arange(horizon) < frozen)[None, :, None].astype(float)
    # The flow is linear, so that the mean over all noises is the chunk of no noise.
    guide = Guide(left, flags, np.zeros_like(flags))
    chunk = normal_flow(covariance, guide, np.zeros((1, horizon, dim)), steps)
    posterior = effect @ left[0, :frozen].flatten()
    later = chunk[0, frozen:].flatten()
    return float(np.linalg.norm(later - posterior) / np.linalg.norm(posterior))


@pytest.mark.torch
@settings(deadline=None, max_examples=100)
@given(coupled(most=0.3))
def test_later_rows_converge_to_the_mean_of_their_posterior(case: Any) -> None:
    """The paper's gain is exact for frozen values that are independent of all others.

    For a coupling A it neglects terms of the order of A squared. Euler's method has an error of the
    order of a step.
    """
    covariance, effect, horizon, dim, frozen = case
    neglected = np.linalg.norm(effect, 2) ** 2
    for steps in (10, 40, 160):
        error = error_of_later_rows(covariance, effect, (horizon, dim), frozen, steps)
        assert error < 2 / steps + neglected


@pytest.mark.torch
@settings(deadline=None, max_examples=100)
@given(coupled(most=2.0), st.sampled_from([5, 10, 50]))
def test_frozen_rows_move_the_later_ones_towards_the_mean_of_their_posterior(
    case: Any, steps: int
) -> None:
    covariance, effect, horizon, dim, frozen = case
    error = error_of_later_rows(covariance, effect, (horizon, dim), frozen, steps)
    # Without the Jacobian, the error reaches 0.8.
    assert error < 0.6


@pytest.mark.torch
@settings(deadline=None, max_examples=100)
@given(
    shape=st.tuples(st.integers(1, 10), st.integers(1, 4)),
    seed=st.integers(0, 2**32 - 1),
    time=st.floats(0.05, 1.0),
    limit=st.floats(0.5, 20),
)
def test_the_correction_is_that_of_the_closed_form(
    shape: tuple[int, int], seed: int, time: float, limit: float
) -> None:
    """For any covariance and any weights, also if they rise."""
    import torch

    rng = np.random.default_rng(seed)
    count = shape[0] * shape[1]
    mixed = rng.standard_normal((count, count))
    covariance = mixed @ mixed.T / count + 0.05 * np.eye(count)
    left, noisy = rng.standard_normal((2, 1, *shape))
    weight = rng.uniform(0, 1, (1, shape[0], 1))
    frozen = np.where(rng.uniform(size=weight.shape) < 0.3, 1 - weight, 0)

    matrix = denoiser(covariance, time)
    expected = (matrix @ noisy.flatten()).reshape(noisy.shape)
    error = ((weight + frozen) * (left - expected)).flatten()
    correction = (matrix.T @ error).reshape(noisy.shape)
    gain = min(limit, ((1 - time) ** 2 + time**2) / (time * (1 - time) + 1e-6))
    wanted = (noisy - expected) / time - gain * correction

    tensor = torch.from_numpy(matrix)
    guide = Guide(left, frozen, weight).to(torch.from_numpy)
    found = guide.steer(
        lambda values: (values - (tensor @ values.flatten()).reshape(values.shape)) / time,
        torch.from_numpy(noisy),
        time,
        limit=limit,
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-9)


STEP = 0.25  # increment between the rows of the policy below


class Prefixed(FlowPasses):
    """A policy that was trained with prefixes. Its rows continue from the last row at time 0, by
    STEP each.
    """

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        return state, mask

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        import torch

        given = times == 0
        last = given.sum(1) - 1
        start = actions[torch.arange(len(actions)), last.clamp(min=0)] * (last >= 0)[:, None]
        behind = torch.arange(HORIZON)[None, :, None] - last[:, None, None]
        wanted = (actions - start[:, None] - STEP * behind) / times.clamp(min=1e-6)[..., None]
        # The velocity of given rows was never trained.
        return torch.where(given[..., None], 100.0, wanted)


def prefixed(*rows: Row) -> np.ndarray:
    """Return (B, H, D) actions of `Prefixed`."""
    import torch

    passes = Prefixed(torch.nn.Identity(), Compilation(False))
    passes.by_row = True
    guide = Guide.for_rows(rows, HORIZON, DIM)
    assert guide is not None
    guide = guide.to(torch.from_numpy)
    noise = torch.from_numpy(np.stack([one.noise(HORIZON, DIM) for one in rows]))
    there = torch.ones(len(rows), 1, dtype=torch.bool)
    found = passes.sample(
        [torch.zeros(len(rows), 3, 8, 8)],
        [there[:, 0]],
        torch.zeros(len(rows), 1, dtype=torch.long),
        there,
        noise=guide.insert_frozen(noise),
        owners=range(len(rows)),
        steps=STEPS,
        changes=[guide.keep],
        frozen=guide.frozen,
    )
    return np.asarray(found)


@pytest.mark.torch
@pytest.mark.parametrize("delay", [1, 3, 6])
def test_a_given_prefix_comes_back_unchanged_and_the_rest_continues_it(delay: int) -> None:
    actions = prefixed(row(plan(), delay))[0]
    np.testing.assert_array_equal(actions[:delay], plan()[:delay])
    np.testing.assert_allclose(np.diff(actions[delay - 1 :], axis=0), STEP, atol=1e-5)


@pytest.mark.torch
def test_prefixes_of_other_lengths_in_a_batch_do_not_matter() -> None:
    rows = [row(plan(), 2), row(), row(plan(3), 5)]
    both = prefixed(*rows)
    np.testing.assert_allclose(np.diff(both[1], axis=0), STEP, atol=1e-5)  # the row without a plan
    for one, delay in ((0, 2), (2, 3)):
        np.testing.assert_allclose(
            both[one], prefixed([row(plan(), 2), row(), row(plan(3), 5)][one])[0], atol=1e-6
        )
        np.testing.assert_array_equal(both[one][:delay], plan(6 if one == 0 else 3)[:delay])
