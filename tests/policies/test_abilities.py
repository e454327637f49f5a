"""Abilities: an agent has the abilities whose protocols it implements, and a wrapper has those of
its policy, without listing them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import pytest

from vlagents_ray import Act, Agent, Obs, TrainableAgent, abilities
from vlagents_ray.abilities import (
    ContinuesPlans,
    Forwards,
    InProcess,
    Interruptible,
    Observes,
    Prepares,
    Sleeps,
    Speculative,
    Trainable,
    ability,
    is_marked,
    members,
    observation_arguments,
)
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.wrapper import Wrapper
from vlagents_ray.testing import check_agent


class Dances(Protocol):
    """An ability that only this test defines."""

    tempo: float

    def dance(self, obs: Obs, times: int, *, fast: bool = False) -> str:
        """Dance to an observation."""

    def rest(self, seconds: float) -> str:
        """Rest."""


class Rehearses(Speculative, Protocol):
    """Another such ability, which is called on an observation before its turn."""

    def rehearse(self, obs: Obs) -> str:
        """Rehearse an observation."""


def protocols_of(module: Any) -> list[type]:
    """Return the protocols of abilities in a module. Marker classes have no members, and `Forwards`
    is the mechanism that passes abilities on.
    """
    found = []
    for value in vars(module).values():
        is_protocol = isinstance(value, type) and Protocol in value.__mro__[1:]  # type: ignore[comparison-overlap]
        if is_protocol and value.__module__ == module.__name__ and members(value):
            found.append(value)
    return [protocol for protocol in found if protocol is not Forwards]


PROTOCOLS = [*protocols_of(abilities), Dances, Rehearses]


def methods_of(protocol: type) -> list[str]:
    return [name for name in members(protocol) if inspect.isfunction(getattr(protocol, name, None))]


class Plain(Agent):
    """A policy without any ability."""

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(1, np.float32))


class Same(Wrapper):
    """A wrapper that changes no observation."""


class Counted(Wrapper):
    """A wrapper that changes observations, and counts the observations of its session, like a
    tracker.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__(agent)
        self.count = 0

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        changed: list[Obs | Exception] = []
        for session_obs, session in zip(obs, sessions, strict=True):
            session.count += 1  # type: ignore[attr-defined]
            changed.append(replace(session_obs, gripper=(session_obs.gripper or 0.0) + 1))
        return changed


class Brightened(Wrapper):
    """A wrapper that always changes an observation in the same way."""

    repeatable = True

    def change_batch(
        self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
    ) -> list[Obs | Exception]:
        return [Obs(gripper=(session_obs.gripper or 0.0) + 1) for session_obs in obs]


AROUND: dict[str, tuple[Callable[[Agent], Agent], int, bool]] = {
    # The number of changes of an observation, and whether the change may be repeated.
    "alone": (lambda agent: agent, 0, True),
    "wrapped": (Same, 0, True),
    "wrapped twice": (lambda agent: Same(Same(agent)), 0, True),
    "changed": (Brightened, 1, True),
    "changed twice": (lambda agent: Brightened(Same(Brightened(agent))), 2, True),
    "tracked": (Counted, 1, False),
    "tracked inside": (lambda agent: Brightened(Counted(Same(agent))), 2, False),
    "tracked outside": (lambda agent: Counted(Brightened(agent)), 2, False),
}


def policy_with(protocol: type, calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]]) -> Agent:
    """Return a policy with an ability, whose methods record their arguments."""

    def recording(name: str) -> Callable[..., Any]:
        def method(self: Agent, *args: Any, **kwargs: Any) -> str:
            calls.append((name, args, kwargs))
            return f"result of {name}"

        return method

    body: dict[str, Any] = {name: f"value of {name}" for name in members(protocol)}
    body.update({name: recording(name) for name in methods_of(protocol)})
    cls = type("Able", (Plain,), body)
    agent: Agent = cls()
    return agent


@pytest.mark.parametrize("around", AROUND)
@pytest.mark.parametrize("protocol", PROTOCOLS, ids=lambda protocol: protocol.__name__)
def test_a_wrapper_has_an_ability_if_its_policy_has_it(protocol: type, around: str) -> None:
    wrap, changes, is_repeatable = AROUND[around]
    assert ability(wrap(Plain()), protocol) is None

    calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
    able: Any = ability(wrap(policy_with(protocol, calls)), protocol)
    if is_marked(protocol, Speculative) and not is_repeatable:
        assert able is None, "the wrapper would change the observation twice"
        return

    assert able is not None
    for name in set(members(protocol)) - set(methods_of(protocol)):
        assert getattr(able, name) == f"value of {name}"
    for name in methods_of(protocol):
        signature = inspect.signature(getattr(protocol, name))
        arguments: dict[str, Any] = {argument: object() for argument in [*signature.parameters][1:]}
        observing = observation_arguments(protocol).get(name)
        if observing is not None:
            arguments[observing] = Obs(gripper=0.25)
        bound = signature.bind(None, **arguments)

        assert getattr(able, name)(*bound.args[1:], **bound.kwargs) == f"result of {name}"

        if observing is not None:
            bound.arguments[observing] = Obs(gripper=0.25 + changes)
        assert calls.pop() == (name, bound.args[1:], bound.kwargs)
        assert not calls


def test_the_abilities_of_the_module_are_found() -> None:
    assert {Prepares, Observes, Trainable, Sleeps, Interruptible} <= set(protocols_of(abilities))


def test_an_ability_of_the_wrapper_is_its_own() -> None:
    class Watching(Counted):
        def observe(self, obs: Obs) -> None:
            self.observed = obs

    calls: list[Any] = []
    wrapper = Watching(policy_with(Observes, calls))
    assert ability(wrapper, Observes) is wrapper
    assert ability(Same(wrapper), Observes) is wrapper


def test_the_sessions_of_a_wrapper_have_their_own_policies_abilities() -> None:
    class Remembering(Plain):
        observed = 0

        def observe(self, obs: Obs) -> None:
            self.observed += 1

    copies = AgentCopies(Counted(Remembering()))
    first, second = copies.make(), copies.make()
    observes = ability(first, Observes)
    assert observes is not None
    observes.observe(Obs())
    assert (first.count, second.count) == (1, 0)  # type: ignore[attr-defined]
    assert (first.agent.observed, second.agent.observed) == (1, 0)  # type: ignore[attr-defined]


def test_an_observation_that_cannot_be_changed_is_an_error_of_the_call() -> None:
    class Refusing(Wrapper):
        def change_batch(
            self, obs: Sequence[Obs], sessions: Sequence[Wrapper]
        ) -> list[Obs | Exception]:
            return [ValueError("no camera") for _ in obs]

    calls: list[Any] = []
    observes = ability(Refusing(policy_with(Observes, calls)), Observes)
    assert observes is not None
    with pytest.raises(ValueError, match="no camera"):
        observes.observe(Obs())
    assert not calls


def test_half_of_a_protocol_is_no_ability() -> None:
    class Asleep(Plain):
        def sleep(self) -> None: ...

    class Tireless(Asleep):
        wake = None

    assert ability(Asleep(), Sleeps) is None
    assert ability(Tireless(), Sleeps) is None


def test_a_property_of_an_ability_is_not_evaluated() -> None:
    class Remote(Plain):
        @property
        def continues_plans(self) -> bool:
            raise TimeoutError("no answer from the server")

    agent = Remote()
    assert ability(Same(agent), ContinuesPlans) is agent


def test_an_agent_that_names_its_parameters_is_trainable() -> None:
    class Trained(TrainableAgent, Plain):
        trainable = "tree"

        def initialize(self) -> None:
            self.tree = {"gain": np.zeros(2)}

    agent = Trained()
    agent.initialize()
    trainable = ability(Same(agent), Trainable)
    assert trainable is agent
    assert agent.shared_objects() == [agent.tree]
    assert isinstance(agent, Trainable)
    assert not isinstance(Plain(), Trainable)


class Preparing(Plain):
    """A policy that acts on its prepared value if there is one."""

    def prepare(self, obs: Obs) -> Any:
        return np.float32(obs.gripper or 0.0)

    def act(self, obs: Obs) -> Act:
        prepared = self.prepare(obs) if obs.prepared is None else obs.prepared
        return Act(np.array([prepared], np.float32))


def test_the_policy_gets_what_was_prepared_through_its_wrapper() -> None:
    wrapper = Brightened(Preparing())
    prepares = ability(wrapper, Prepares)
    assert prepares is not None
    obs = Obs(gripper=0.25)
    obs.prepared = prepares.prepare(obs)
    assert obs.prepared == 1.25

    obs.prepared = np.float32(7)  # this value shows that the policy does not prepare again
    assert wrapper.act(obs).action.tolist() == [7]
    check_agent(Brightened(Preparing()), obs=[Obs(gripper=value) for value in (0.1, 0.2, 0.3)])


def test_a_protocol_passes_one_observation_in_a_call() -> None:
    class OfMany(Protocol):
        def look(self, observations: Sequence[Obs]) -> None: ...

    class OfTwo(Protocol):
        def compare(self, obs: Obs, other: Obs) -> None: ...

    for protocol in (OfMany, OfTwo):
        with pytest.raises(TypeError, match="at most one argument with an observation"):
            observation_arguments(protocol)


def test_marks_have_no_members() -> None:
    assert members(InProcess) == members(Speculative) == ()
    assert is_marked(Prepares, InProcess)
    assert not is_marked(Observes, Speculative)
