"""π0 with compiled cores acts as without, on a small random checkpoint."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from counting_compiler import counting_compiler
from pushed_weights import check_pushed_weights

from tests.families.pi0 import tiny
from tests.families.pi0.conftest import BATCHED, begun, made, seen
from vlagents_ray.interface import BEHAVIOUR, DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, WANT, Act, Obs
from vlagents_ray.policies.pi0 import Pi0

SIZE = 3


@pytest.fixture(scope="module")
def programs() -> Iterator[list[int]]:
    """The rows of each program that is made."""
    with counting_compiler() as compiler:
        yield compiler.rows


@pytest.fixture(scope="module")
def plain(folder: Path) -> Pi0:
    return made(folder, noise_level=0.5)


@pytest.fixture(scope="module")
def compiled(folder: Path, programs: list[int]) -> Pi0:
    policy = made(folder, noise_level=0.5, compile="require", batch_sizes=[SIZE])
    assert programs == [SIZE, SIZE]  # what is seen, and one step of the flow
    return policy


def acts(policy: Pi0, views: list[Obs]) -> list[Act]:
    found = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    assert all(isinstance(act, Act) for act in found)
    return found  # type: ignore[return-value]


def test_batches_of_any_size_are_those_without_compilation(plain: Pi0, compiled: Pi0) -> None:
    for size in (1, 2, SIZE, SIZE + 1):
        views = [seen(i) for i in range(size)]
        for one, other in zip(acts(plain, views), acts(compiled, views), strict=True):
            np.testing.assert_allclose(one.action, other.action, atol=BATCHED)


def test_plans_samples_and_random_steps_are_those_without_compilation(
    plain: Pi0, compiled: Pi0, programs: list[int]
) -> None:
    plan = np.ones((6, tiny.ACTION_DIM), np.float32)
    views = [
        seen(0, **{LEFTOVER: plan, DELAY: 2}),
        seen(1, **{SAMPLES: 2, WANT: ["logprob"]}),
    ]
    for one, other in zip(acts(plain, views), acts(compiled, views), strict=True):
        np.testing.assert_allclose(one.action, other.action, atol=BATCHED)
        if DISTRIBUTION in one.info:
            samples = [act.info[DISTRIBUTION]["samples"] for act in (one, other)]
            np.testing.assert_allclose(*samples, atol=BATCHED)
            said = [act.info[BEHAVIOUR]["logprob"] for act in (one, other)]
            np.testing.assert_allclose(*said, atol=2e-3)  # sums over steps of a tenth
    assert programs == [SIZE, SIZE]


def test_it_acts_with_pushed_weights(compiled: Pi0, programs: list[int]) -> None:
    check_pushed_weights(compiled, lambda: begun(compiled, 0).act(seen(0)).action)
    assert programs == [SIZE, SIZE]
