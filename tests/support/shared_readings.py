"""A check that inputs of the same observation, computed once for all its samples, give the same
actions as when computed for each sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.interface import DISTRIBUTION


def check_shared_readings(
    policy: Any,
    views: Sequence[Obs],
    begun: Callable[[Any, int], Agent],
    module: ModuleType,
    atol: float,
) -> None:
    """Check that a policy's actions do not change when `shared_frames` of its module is
    disabled.
    """
    shared = policy.act_batch(views, [begun(policy, number) for number in range(len(views))])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            module, "shared_frames", lambda rows: (list(range(len(rows))), list(range(len(rows))))
        )
        each = policy.act_batch(views, [begun(policy, number) for number in range(len(views))])
    for one, other in zip(shared, each, strict=True):
        assert isinstance(one, Act)
        assert isinstance(other, Act)
        np.testing.assert_allclose(one.action, other.action, atol=atol)
        if DISTRIBUTION in one.info:
            np.testing.assert_allclose(
                *(act.info[DISTRIBUTION]["samples"] for act in (one, other)), atol=atol
            )
