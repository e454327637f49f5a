"""V-JEPA 2-AC with compiled cores plans as without, on a small random checkpoint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from counting_compiler import counting_compiler

from tests.families.vjepa2_ac.test_policy import begun, checkpoint, obs, policy, pytestmark  # noqa: F401 - fixtures
from tests.families.vjepa2_ac.tiny import SETTINGS
from vlagents_ray import Act
from vlagents_ray.interface import SAMPLES
from vlagents_ray.policies.vjepa2_ac import VJepa2Ac

SIZE = 2


@pytest.mark.parametrize("pass_size", [400, 5])  # more than the 12 plans of an iteration, and no divisor of them
def test_plans_of_batches_of_any_size_are_those_without_compilation(
    pass_size: int,
    checkpoint: Path,  # noqa: F811
    policy: VJepa2Ac,  # noqa: F811
) -> None:
    settings = {"checkpoint": str(checkpoint), **SETTINGS, "pass_size": pass_size}
    with counting_compiler() as compiler:
        compiled = VJepa2Ac.from_config({**settings, "compile": "require", "batch_sizes": [SIZE]})
        compiled.initialize()
        plans = min(pass_size, SETTINGS["samples"])
        assert sorted(compiler.rows) == sorted([SIZE, plans, plans])  # the encoder, and each step of a plan
        for size in (1, SIZE, SIZE + 1):
            views = [obs(10 + i) for i in range(size)]
            views[0].info[SAMPLES] = 2
            acts = [
                which.act_batch(views, [begun(which, i, goal=i) for i in range(size)]) for which in (policy, compiled)
            ]
            for one, other in zip(*acts, strict=True):
                assert isinstance(one, Act)
                assert isinstance(other, Act)
                np.testing.assert_allclose(one.action, other.action, atol=1e-4)
        assert len(compiler.rows) == 3
