"""JAX parameters must be those of the model, each of them read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.checkpoint import require_filled

WANTED = {"dense": {"kernel": np.empty((2, 3)), "bias": np.empty(3)}, "scale": np.empty(1)}


def test_parameters_of_the_right_names_and_shapes_pass() -> None:
    require_filled({"scale": np.ones(1), "dense": {"bias": np.ones(3), "kernel": np.ones((2, 3))}}, WANTED)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"dense": {"kernel": np.ones((2, 3))}, "scale": np.ones(1)}, r"1 parameters are not in it \['dense/bias'\]"),
        ({**WANTED, "scale": SimpleNamespace(shape=(1,))}, r"1 parameters are not in it \['scale'\]"),
        ({**WANTED, "scale": np.ones(2)}, r"1 have another shape \['scale'\]"),
        ({**WANTED, "extra": {"bias": np.ones(2)}}, r"1 are not the model's \['extra/bias'\]"),
    ],
)
def test_what_is_missing_other_or_too_much_is_named(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        require_filled(params, WANTED)
