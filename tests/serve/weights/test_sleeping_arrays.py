"""JAX weights of a policy that sleeps, with a simulation of JAX whose arrays are on a GPU."""

from __future__ import annotations

import threading
from typing import ClassVar

import numpy as np
import pytest
from fake_jax import Array, Gpu

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.serve.weights import ModelWeights, PushOptions

ALL = PushOptions("keep")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Gpu:
    gpu = Gpu()
    gpu.install(monkeypatch)
    return gpu


class OnGpu(TrainableAgent):
    """A policy with two arrays on the GPU and a number on the host."""

    trainable: ClassVar[str | None] = "tree"

    def __init__(self) -> None:
        self.tree = {
            "layer": {"w": Array([1.0, 2.0], "gpu:0"), "b": Array([3.0], "gpu:1")},
            "scale": np.ones(1),
        }

    def act(self, obs: Obs) -> Act:
        layer = self.tree["layer"]
        return Act(np.asarray(layer["w"]) * self.tree["scale"] + np.asarray(layer["b"]))


def test_jax_weights_leave_the_gpu_and_return_to_where_they_were(gpu: Gpu) -> None:
    agent = OnGpu()
    weights = ModelWeights(agent, threading.Lock())
    before = agent.act(Obs()).action.tolist()
    weights.stage(1, {"layer/b": np.full(1, 9.0)}, PushOptions(partial=True))
    weights.commit(1, ALL, list)
    pinned, newest = weights.pinned, weights.newest
    assert gpu.count() == 3, "both versions have the same `w`"

    weights.sleep(offload=True)
    assert gpu.count() == 0
    with pytest.raises(PolicyUnavailable, match="got one that sleeps"):
        weights.portable_values(newest)

    weights.wake()
    assert gpu.count() == 3
    assert agent.tree["layer"]["b"].sharding == "gpu:1"
    assert agent.act(Obs()).action.tolist() == before
    weights.use(newest)
    assert agent.act(Obs()).action.tolist() == [10.0, 11.0]
    weights.use(pinned)
    assert agent.act(Obs()).action.tolist() == before


def test_a_wake_that_does_not_fit_continues_where_it_stopped(gpu: Gpu) -> None:
    agent = OnGpu()
    weights = ModelWeights(agent, threading.Lock())
    before = agent.act(Obs()).action.tolist()
    weights.sleep(offload=True)
    gpu.fits = 1
    for _ in range(2):
        with pytest.raises(PolicyUnavailable, match="too little memory for the policy"):
            weights.wake()
        assert gpu.count() == 1
    gpu.fits = 2
    weights.wake()
    assert gpu.count() == 2
    assert agent.act(Obs()).action.tolist() == before


def test_a_sleep_that_only_empties_caches_moves_no_array(gpu: Gpu) -> None:
    weights = ModelWeights(OnGpu(), threading.Lock())
    weights.sleep(offload=False)
    assert gpu.count() == 2
