"""Policies with compiled cores act as without, on small random checkpoints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from counting_compiler import CountingCompiler, counting_compiler

from tests.families.diffusion_policy.conftest import LIBRARIES, Checkpoint, begun, loaded, seen
from vlagents_ray import Obs
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.diffusion_policy import DiffusionPolicy

pytestmark = [pytest.mark.source("DIFFUSION_POLICY_SRC"), *LIBRARIES]

CORES = {"unet": 1, "transformer": 1, "image": 2, "hybrid": 2}  # a step from noise, and what is seen in images
SIZE = 3
ATOL = 1e-5  # float32 on a CPU, actions between -3 and 5


@pytest.fixture(scope="module")
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as made:
        yield made


@pytest.fixture(scope="module", params=CORES)
def both(
    request: pytest.FixtureRequest, checkpoint: Checkpoint, compiler: CountingCompiler
) -> tuple[DiffusionPolicy, DiffusionPolicy]:
    """A policy, and the same one compiled."""
    file, before = checkpoint(request.param), len(compiler.rows)
    compiled = loaded(file, actions="chunk", compile="require", batch_sizes=[SIZE])
    assert compiler.rows[before:] == [SIZE] * CORES[request.param]
    return loaded(file, actions="chunk"), compiled


def acts(policy: DiffusionPolicy, views: list[Obs]) -> list[Act]:
    found = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    assert all(isinstance(act, Act) for act in found)
    return found  # type: ignore[return-value]


def test_batches_of_any_size_are_those_without_compilation(
    both: tuple[DiffusionPolicy, DiffusionPolicy], compiler: CountingCompiler
) -> None:
    made = len(compiler.rows)
    for size in (1, 2, SIZE, SIZE + 1):
        before = compiler.calls
        plain, compiled = (acts(policy, [seen(i) for i in range(size)]) for policy in both)
        for one, other in zip(plain, compiled, strict=True):
            np.testing.assert_allclose(one.action, other.action, atol=ATOL)
        assert compiler.calls > before
    assert len(compiler.rows) == made


def test_samples_are_those_without_compilation(
    both: tuple[DiffusionPolicy, DiffusionPolicy], compiler: CountingCompiler
) -> None:
    made = len(compiler.rows)
    views = [seen(0), seen(1, **{SAMPLES: 2})]
    for one, other in zip(*(acts(policy, views) for policy in both), strict=True):
        np.testing.assert_allclose(one.action, other.action, atol=ATOL)
    samples = [acts(policy, views)[1].info[DISTRIBUTION]["samples"] for policy in both]
    np.testing.assert_allclose(*samples, atol=ATOL)
    assert len(compiler.rows) == made
