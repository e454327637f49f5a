"""OpenVLA and OFT with compiled cores act as without, on tiny random checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from counting_compiler import CountingCompiler, counting_compiler

from plugins.vlagents_ray_models.tests.families.openvla.conftest import (
    LIBRARIES,
    WORDS,
    begun,
    seen,
)
from plugins.vlagents_ray_models.tests.families.openvla.test_oft import SAME, SETTINGS
from vlagents_ray.interface import BEHAVIOUR, DISTRIBUTION, SAMPLES, WANT, Act, Obs

pytestmark = LIBRARIES

SIZE = 2
ATOL = {**SAME, "openvla": 1e-6}


@pytest.fixture
def compiler() -> Iterator[CountingCompiler]:
    with counting_compiler() as compiler:
        yield compiler


def acts(policy: Any, seeds: list[int], **info: Any) -> list[Act]:
    views: list[Obs] = [seen(seed, **info) for seed in seeds]
    outcomes = policy.act_batch(views, [begun(policy, seed) for seed in seeds])
    assert all(isinstance(outcome, Act) for outcome in outcomes)
    return outcomes  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("kind", "cores"),
    [
        pytest.param("openvla", 3, marks=pytest.mark.source("OPENVLA_SRC")),
        *(pytest.param(kind, 2, marks=pytest.mark.source("OPENVLA_OFT_SRC")) for kind in SETTINGS),
    ],
)
def test_acts_are_those_without_compilation_also_of_long_prompts(
    loaded: Callable[..., Any], compiler: CountingCompiler, kind: str, cores: int
) -> None:
    settings = SETTINGS.get(kind, {})
    plain = loaded(kind, **settings)
    base = getattr(plain.model, "base", plain.model)
    lengths = [len(base.tokens(words)) for words in WORDS]
    assert lengths[2] > max(lengths[:2]) + 1

    compiled = type(plain).from_config(
        plain.config.model_dump(exclude_unset=True)
        | {"compile": "require", "batch_sizes": [SIZE], "compiled_tokens": max(lengths[:2]) + 1}
    )
    compiled.initialize()
    assert compiler.rows == [SIZE] * cores

    for seeds in ([0], [1, 0], [0, 1, 0], [2], [0, 2]):
        calls = compiler.calls
        for expected, act in zip(acts(plain, seeds), acts(compiled, seeds), strict=True):
            np.testing.assert_allclose(expected.action, act.action, atol=ATOL[kind])
        assert compiler.calls > calls  # images, at least

    if plain.contract.behaviour:
        info = {SAMPLES: 2, WANT: ["logprob"]}
        for pair in zip(acts(plain, [0, 1], **info), acts(compiled, [0, 1], **info), strict=True):
            samples = [act.info[DISTRIBUTION]["samples"] for act in pair]
            np.testing.assert_allclose(*samples, atol=ATOL[kind])
            logprobs = [act.info[BEHAVIOUR]["logprob"] for act in pair]
            np.testing.assert_allclose(*logprobs, atol=1e-4)
    assert compiler.rows == [SIZE] * cores
