"""A learner in the process of the policy."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest
from in_flight import submit

from vlagents_ray.errors import ConfigError, InvalidInput, InvalidWeights, UnchangedWeights
from vlagents_ray.interface import Act, Obs, TrainableAgent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.weights.trainable import fingerprint
from vlagents_ray_learn import Publisher


class Linear(TrainableAgent):
    """Acts with two named arrays."""

    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {"w": np.zeros(2, np.float32), "b": np.zeros(2, np.float32)}

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["w"] + self.tree["b"])


def act(engine: Engine, session: str = "s") -> Act:
    """The first act of an episode of a simulation."""
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    for request in (
        Request("reset", Obs(), priority="simulation"),
        Request("act", Obs(), priority="simulation"),
    ):
        submit(engine, session, request, replies.put)
        reply = replies.get(timeout=30)
    assert reply.act is not None, reply.error
    return reply.act


@pytest.fixture
def engine() -> Iterator[Engine]:
    found = Engine(Linear())
    found.start()
    yield found
    found.close()


def test_the_learner_and_the_policy_name_the_same_weights(engine: Engine) -> None:
    model = {"w": np.ones(2, np.float32), "b": np.ones(2, np.float32)}
    with Publisher(engine) as weights:
        for version in (1, 2, 3):
            model["w"] += 1  # as an optimizer does, in place
            assert weights.push(model) == version
            acted = act(engine)
            assert acted.info["policy"] == {"version": version, "fingerprint": fingerprint(model)}
            assert acted.action[0] == version + 2
            assert (weights.acknowledged(version), weights.acknowledged(version + 1)) == (1, 0)


def test_a_part_of_the_weights_leaves_the_rest(engine: Engine) -> None:
    weights = Publisher(engine)
    weights.push({"w": np.full(2, 3.0), "b": np.full(2, 4.0)})
    with pytest.raises(InvalidWeights, match="'b': missing; push it, or set partial=True"):
        weights.push({"w": np.zeros(2)})
    assert weights.push({"w": np.ones(2)}, partial=True) == 2
    assert act(engine).action[0] == 5


def test_mistakes_are_refused_by_name(engine: Engine) -> None:
    weights = Publisher(engine)
    with pytest.raises(UnchangedWeights):
        weights.push(engine.model.own_weights._trainable.parameters())
    with pytest.raises(InvalidWeights, match=r"expected values by name, .*got list"):
        weights.push([np.zeros(2)])  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"mode: expected .*, got 'abort'"):
        weights.push({}, mode="abort")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"Publisher: expected .*, got 7"):
        Publisher(7)  # type: ignore[arg-type]
    assert act(engine).info["policy"]["version"] == 0
