"""Pushes of new weights to one engine or policy, without a learner, and a check that a policy acts
with pushed weights, and again as before with its original weights.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlagents_ray.interface import Agent
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import ModelWeights, PushOptions
from vlagents_ray.weights.trainable import own_copy

_FACTOR = 0.8  # factor for all numbers of a network, with which actions change but remain finite


def push(engine: Engine, named: Mapping[str, Any], **options: Any) -> int:
    """Push new weights to an engine as the only replica, and return their version."""
    number = engine.weights.number + 1
    engine.weights.stage(number, named, PushOptions(**options))
    engine.weights.commit(number, PushOptions(**options))
    return number


def check_pushed_weights(agent: Agent, act: Callable[[], np.ndarray], part: str = "") -> None:
    """Push other weights and the loaded ones, twice, and compare the actions.

    Args:
        agent: The policy, initialized.
        act: A function that returns the first action of the same episode in each call.
        part: A text in the names of the pushed values; if it is empty, all values are pushed.
    """
    weights = ModelWeights(agent, threading.Lock())
    as_loaded = act()
    loaded = {name: own_copy(value) for name, value in agent.parameters().items() if part in name}
    scaled = {
        name: value * _FACTOR if "float" in str(value.dtype) else value
        for name, value in loaded.items()
    }
    options = PushOptions("keep", partial=bool(part))

    def push(number: int, values: Mapping[str, Any]) -> np.ndarray:
        weights.stage(number, values, options)
        weights.commit(number, options, list)
        weights.use(weights.newest)
        return act()

    other = push(1, scaled)
    assert other.shape == as_loaded.shape
    assert not np.allclose(other, as_loaded)

    # The values of a checkpoint may be in the memory of its file, with another alignment than
    # pushed values. The alignment changes the CPU's kernels and thus the last bits of results.
    restored = push(2, loaded)
    np.testing.assert_allclose(restored, as_loaded, rtol=1e-5, atol=1e-6)

    np.testing.assert_array_equal(push(3, scaled), other)
    np.testing.assert_array_equal(push(4, loaded), restored)
