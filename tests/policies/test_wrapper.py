"""Wrappers: a policy receives changed observations, in each session and through each of its
calls.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import BaseModel

from vlagents_ray import Act, Agent, Obs, TrainableAgent
from vlagents_ray.abilities import (
    ChecksHealth,
    HasStatistics,
    HasWeightsId,
    Observes,
    ability,
)
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidObservation,
    NotTrainable,
    PolicyFailed,
    UnknownPolicy,
)
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.wrapper import Wrapper, build_agent, require_trainable
from vlagents_ray.testing import check_agent


class Bright(Agent):
    """A policy that returns the brightness of its camera, and the number of its session's
    observations.
    """

    shared = ("weights",)

    def initialize(self) -> None:
        self.weights = [1.0]
        self.seen = 0

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2))

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {"first": int(obs.cameras["front"].max())}

    def observe(self, obs: Obs) -> None:
        self.seen += 1

    def act(self, obs: Obs) -> Act:
        self.seen += 1
        return Act(np.array([obs.cameras["front"].max(), self.seen], np.float32))


class DimConfig(BaseModel, extra="forbid"):
    by: int = 1


class Dim(Wrapper):
    """A wrapper that subtracts `by` from each pixel, and one more with each observation of the
    session.
    """

    Config = DimConfig

    def __init__(self, agent: Agent, config: DimConfig) -> None:
        super().__init__(agent, config)
        self.count = 0

    def begin(self, obs: Obs, instruction: str | None) -> Obs:
        [first] = self.change_batch([obs], [self])
        assert isinstance(first, Obs)
        return first

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        return [self._dim(one, session) for one, session in zip(obs, sessions, strict=True)]  # type: ignore[arg-type]

    def _dim(self, obs: Obs, session: Dim) -> Obs | Exception:
        if "front" not in obs.cameras:
            return InvalidObservation("no front camera")
        session.count += 1
        return Obs(
            cameras={"front": obs.cameras["front"] - np.uint8(self.config.by + session.count)}
        )


BRIGHT, DIM = f"{__name__}:Bright", f"{__name__}:Dim"


def seen(value: int) -> Obs:
    return Obs(cameras={"front": np.full((4, 4, 3), value, np.uint8)})


def test_keeps_the_contract() -> None:
    check_agent(Dim(Bright(), DimConfig()), obs=[seen(100), seen(150), seen(200)])


def test_each_call_shows_the_policy_the_changed_observation() -> None:
    agent = Dim(Bright(), DimConfig(by=10))
    agent.initialize()
    session = AgentCopies(agent).make()
    assert session.reset(seen(100), None) == {"first": 89}
    observes = ability(session, Observes)
    assert observes is not None
    observes.observe(seen(100))
    assert session.act(seen(100)).action.tolist() == [87, 2]


def test_what_the_policy_shares_is_shared_through_its_wrappers() -> None:
    agent = Dim(Dim(Bright(), DimConfig()), DimConfig())
    agent.initialize()
    copies = AgentCopies(agent)
    one, two = copies.make(), copies.make()
    assert one.agent.agent.weights is two.agent.agent.weights  # type: ignore[attr-defined]
    assert one.agent is not two.agent  # type: ignore[attr-defined]


def test_an_observation_that_cannot_be_changed_fails_its_own_session_alone() -> None:
    agent = Dim(Bright(), DimConfig())
    agent.initialize()
    copies = AgentCopies(agent)
    bad, good = agent.act_batch([Obs(), seen(9)], [copies.make(), copies.make()])
    assert isinstance(bad, InvalidObservation)
    assert isinstance(good, Act)


def test_the_first_wrapper_is_the_nearest_to_the_robot() -> None:
    agent = build_agent(BRIGHT, {}, [{DIM: {"by": 1}}, {DIM: {"by": 2}}])
    assert isinstance(agent, Dim)
    assert isinstance(agent.agent, Dim)
    assert (agent.config.by, agent.agent.config.by) == (1, 2)


@pytest.mark.parametrize(
    ("wrappers", "said"),
    [
        (["nothing"], "not registered"),
        ([BRIGHT], "expected a subclass"),
        ([{DIM: {"off": 1}}], "wrapper Dim"),
        ([{DIM: {}, BRIGHT: {}}], "one name with its settings in each entry"),
    ],
)
def test_wrong_entries_are_refused(wrappers: list[Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        build_agent(BRIGHT, {}, wrappers)


def test_a_class_that_is_no_agent_is_refused() -> None:
    with pytest.raises(
        UnknownPolicy, match="'json:JSONDecoder': expected an Agent; derive the class"
    ):
        build_agent("json:JSONDecoder", {})


class Weights(BaseModel, extra="forbid"):
    weights: str
    scale: float = 1.0


class WeightsWithStep(Weights):
    checkpoint_step: int | None = None


class Loads(Agent):
    """A policy that loads a file, with settings of its own."""

    Config: ClassVar[Any] = Weights

    def __init__(self, config: Weights) -> None:
        self.config = config

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


class LoadsAtStep(Loads):
    Config = WeightsWithStep


class LoadsByArgument(Agent):
    """A policy whose settings are the arguments of its constructor."""

    def __init__(self, weights: str) -> None:
        self.config = Weights(weights=weights)

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


@pytest.mark.parametrize("cls", [Loads, LoadsAtStep, LoadsByArgument])
def test_the_step_of_a_sweep_is_filled_into_the_settings_of_any_policy(cls: type[Agent]) -> None:
    settings = {"weights": "runs/a/w{step}.pt", "checkpoint_step": 700}
    agent: Any = build_agent(f"{__name__}:{cls.__name__}", settings)
    assert agent.config.weights == "runs/a/w700.pt"
    assert getattr(agent.config, "checkpoint_step", 700) == 700
    assert settings["weights"] == "runs/a/w{step}.pt"


@pytest.mark.parametrize("cls", [Loads, LoadsByArgument])
def test_a_step_without_a_place_is_refused_with_the_cure(cls: type[Agent]) -> None:
    with pytest.raises(ConfigError, match=r"expected \{step\} in a setting.*training step 700"):
        build_agent(f"{__name__}:{cls.__name__}", {"weights": "w.pt", "checkpoint_step": 700})


def test_what_keeps_the_inner_agent_from_acting_is_said_by_the_wrapper_too() -> None:
    class Lost(Bright):
        def check_health(self) -> None:
            raise PolicyFailed("the device is lost")

    checks = ability(Dim(Lost(), DimConfig()), ChecksHealth)
    assert checks is not None
    with pytest.raises(PolicyFailed, match="the device is lost"):
        checks.check_health()


def test_what_an_agent_says_of_its_weights_is_said_through_a_wrapper() -> None:
    class Described(Bright):
        def initialize(self) -> None:
            super().initialize()
            self.weights_id = {"digest": "x", "revision": None}
            self.statistics = {"action": {"min": [0.0], "max": [1.0]}}

    wrapped = Dim.around(Described(), {})
    assert ability(wrapped, HasWeightsId) is None
    wrapped.initialize()
    has_id, has_statistics = ability(wrapped, HasWeightsId), ability(wrapped, HasStatistics)
    assert has_id is not None
    assert has_id.weights_id == {"digest": "x", "revision": None}
    assert has_statistics is not None
    assert has_statistics.statistics == {"action": {"min": [0.0], "max": [1.0]}}


def test_what_a_learner_trains_is_that_of_the_policy() -> None:
    class Trained(TrainableAgent, Bright):
        trainable = "tree"

        def initialize(self) -> None:
            super().initialize()
            self.tree = {"gain": np.zeros(2)}

    agent = Dim(Trained(), DimConfig())
    agent.initialize()
    trainable = require_trainable(agent)
    trainable.load_parameters({"gain": np.ones(2)})
    assert trainable.parameters()["gain"] is agent.agent.tree["gain"]  # type: ignore[attr-defined]
    assert trainable.parameters()["gain"].tolist() == [1, 1]
    with pytest.raises(NotTrainable, match="Bright: names no parameters"):
        require_trainable(Dim(Bright(), DimConfig()))
