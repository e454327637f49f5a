"""Comparisons that say where two values differ, and what the wire carries."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import Obs
from vlagents_ray.testing import ContractViolation
from vlagents_ray.testing.comparing import difference, require_wireable


def test_a_difference_says_where_it_is() -> None:
    assert difference(Obs(gripper=0.5), Obs(gripper=0.5), "obs") is None
    assert "'gripper'" in str(difference(Obs(gripper=0.5), Obs(gripper=0.6), "obs"))
    assert "has ['a'] once" in str(difference({"a": 1}, {"b": 1}, "info"))
    assert "2 items once" in str(difference([1, 2], [1], "info"))
    assert "(2,) float32 once" in str(difference(np.zeros(2, np.float32), np.zeros(3, np.float32), "x"))
    assert difference(np.zeros(2), np.full(2, 1e-6), "x", atol=1e-5) is None


@pytest.mark.parametrize("value", [object(), (1, 2), {1: "a"}, np.float32(1), np.array(["a"]), {"a": [object()]}, {1}])
def test_what_the_wire_cannot_carry_is_refused(value: object) -> None:
    with pytest.raises(ContractViolation, match="info"):
        require_wireable(value, "info")


def test_what_the_wire_carries_is_accepted() -> None:
    require_wireable({"a": [None, True, 1, 1.5, "x", b"y", np.zeros(2, bool)], "b": {}}, "info")
