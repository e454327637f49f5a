"""Abilities that an agent may have besides `Agent`: each is a protocol with a few methods.

A policy gains an ability when its class defines the methods of the protocol, and needs no other
declaration. A server finds out with `ability` what a loaded agent can do:

    class Reach(Agent):
        def prepare(self, obs):             # the ability `Prepares`
            return resize(obs.cameras["front"])

    prepares = ability(agent, Prepares)     # None if the agent does not prepare observations
    if prepares is not None:
        obs.prepared = prepares.prepare(obs)

A wrapper has the abilities of its inner agent, without naming them (`Forwards`): `ability` then
returns the inner agent, or an object that changes the observations before it passes them on. A
plug-in may define further protocols; they pass through wrappers and child processes in the same
way. Therefore the annotations of a protocol must be types that exist at run time, and an argument
that is an observation must be annotated as `Obs`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import (
    Any,
    Generic,
    Protocol,
    TypeVar,
    cast,
    get_args,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

from vlagents_ray.interface import Agent, Obs
from vlagents_ray.success import SuccessCurve

__all__ = [
    "BeginsWithPlan",
    "ChecksHealth",
    "ContinuesPlans",
    "CountsTicks",
    "Forwards",
    "HasCheck",
    "HasControl",
    "HasStatistics",
    "HasSuccess",
    "HasWeightsId",
    "InProcess",
    "Interruptible",
    "Observes",
    "Prepares",
    "Sleeps",
    "Speculative",
    "Trainable",
    "ability",
]

T = TypeVar("T")


# ----- Marks: properties of the arguments and results of a protocol.


class InProcess(Protocol):
    """Marks abilities whose arguments or results are objects of the policy's process, such as
    references to weights.

    Such values are not sent to another process: if the policy runs in a child process, only that
    child process calls these abilities.
    """


class Speculative(Protocol):
    """Marks abilities that a server may call, on any thread, with an observation that waits for its
    call of `act`. That call may never follow.

    A wrapper changes such an observation twice, for the ability and for `act`. Therefore only
    wrappers that are `Wrapper.repeatable` forward these abilities.
    """


# ----- Abilities of the agent's copy for one session.


@runtime_checkable
class Observes(Protocol):
    """The policy remembers observations, such as a history."""

    def observe(self, obs: Obs) -> None:
        """Add an observation to the history without computing an action.

        When a session is resumed on another replica, a server calls `reset` with the session's
        first observation, and then this method with the last observations for which the policy had
        computed actions.

        Args:
            obs: The observation.
        """


@runtime_checkable
class Prepares(InProcess, Speculative, Protocol):
    """The policy computes a part of an action in advance, while the server computes actions of
    other sessions.
    """

    def prepare(self, obs: Obs) -> Any:
        """Compute values that depend only on one observation and the instruction, such as resized
        images and tokens.

        A server may call this on a session's copy, on several threads at once, while it computes
        actions of other sessions or of an earlier request of the same session. It sets
        `obs.prepared` to the result before it calls `act`. The call is optional: `act` computes the
        same if `obs.prepared` is None. An error fails the request of that observation. Define this
        if it takes a noticeable part of the time of `act`.

        Args:
            obs: The observation to act on next; it must not be changed.

        Returns:
            Any object that does not share memory with the observation. The agent and its shared
            objects must not be changed (for instance the padding of a tokenizer); read only values
            that `initialize` and `reset` have set and that new weights do not change.
        """


@runtime_checkable
class Interruptible(Protocol):
    """The agent has planned actions, and can drop them if the robot did not execute them."""

    def interrupt(self) -> None:
        """Drop the planned actions: the robot was stopped or moved, and did not execute the last
        action of `act`.
        """


# ----- Abilities of the loaded policy.


@runtime_checkable
class ContinuesPlans(Protocol):
    """The policy reads the plan that is being executed, for real-time chunking."""

    continues_plans: bool
    """Whether a chunk continues the plan in `Obs.info` (`LEFTOVER`); if not, the plan is ignored.
    """


@runtime_checkable
class BeginsWithPlan(Protocol):
    """The policy was trained to begin a chunk with the first rows of the plan that is being
    executed, and returns the number of these rows in its `Act` (`GIVEN`).
    """

    longest_prefix: int
    """The largest number of rows of the plan with which a chunk begins; 0 if chunks continue plans
    in another way, such as guidance, or not at all.
    """


@runtime_checkable
class Trainable(InProcess, Protocol):
    """The policy has weights that a learner replaces while it is served. `TrainableAgent` defines
    both methods for an agent that names the attribute with its weights.
    """

    def parameters(self) -> dict[str, Any]:
        """Return references to the values that a learner trains, by name.

        Raises:
            NotTrainable: The agent has no trainable parameters with these settings.
        """

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        """Replace the parameters, for all later actions; a server calls this between two batches.

        Args:
            values: A value for each name of `parameters`, of the same shape, type and device. They
                have been checked, and do not change later; the agent must not change them either.

        Raises:
            NotTrainable: The agent has no trainable parameters with these settings.
        """


@runtime_checkable
class Sleeps(InProcess, Protocol):
    """The policy uses memory on an accelerator besides its parameters, and can free this memory for
    a learner.
    """

    def sleep(self) -> None:
        """Free all memory on an accelerator except that of `parameters`, such as the memory of CUDA
        graphs, until `wake`.

        A server calls this when a learner needs the memory. The server moves the parameters to the
        host itself.
        """

    def wake(self) -> None:
        """Allocate the memory that `sleep` freed; torch tensors of `parameters` are still the same
        objects, but at other addresses.
        """


@runtime_checkable
class ChecksHealth(InProcess, Protocol):
    """The policy detects when it can never compute an action again."""

    def check_health(self) -> None:
        """Raise an exception if this agent can never compute an action again, e.g. after the loss
        of its GPU.

        A server calls this every few seconds, also while a batch runs, and replaces the replica if
        it raises.
        """


@runtime_checkable
class HasWeightsId(Protocol):
    """The policy identifies its weights, for weights that are not loaded from checkpoint files."""

    weights_id: dict[str, Any] | None
    """{"digest": …, "revision": …}, which identify the weights that `initialize` loaded.

    A server reports the digest and the revision, and an evaluation does not mix results with
    different digests. If a policy lacks this attribute, the digest is computed from the files that
    `initialize` found with `vlagents_ray.policies.base.checkpoint.find_checkpoint`.
    """


@runtime_checkable
class HasStatistics(Protocol):
    """The policy has the ranges of states and actions in its training data."""

    statistics: dict[str, Any] | None
    """Ranges as in LeRobot's `stats.json`, {"action": {"min": …, "max": …}, …}.

    They are in the robot's units; None stands for an unknown number. "parts" lists the parts of the
    state in order. A server returns the ranges in its metadata, under `weights`, and `vlagents-ray
    robot` compares them with the robot before its first motion.
    """


# ----- Abilities of an agent that stands for a served policy, such as `RemoteAgent`.


@runtime_checkable
class HasSuccess(InProcess, Protocol):
    """The agent has the measured success of its policy's checkpoint."""

    success_curves: Sequence[SuccessCurve]
    """The curves in the folder of the checkpoint; empty if there are none, or if they were measured
    with other weights or without the policy's wrappers.
    """


# ----- Abilities of an agent on the robot, such as `ChunkPlayer`.


@runtime_checkable
class HasCheck(InProcess, Protocol):
    """The agent checks its actions before it returns them."""

    check: Callable[[np.ndarray, np.ndarray | None], np.ndarray] | None
    """The check that every action from `act` has passed; it is called with the action and the
    previous action, (D,) each.
    """


@runtime_checkable
class HasControl(InProcess, Protocol):
    """The agent reads the state of the robot at each tick."""

    control: Any
    """The `vlagents_ray.chunking.control.RobotControl` of the robot."""


@runtime_checkable
class CountsTicks(InProcess, Protocol):
    """The agent counts the ticks at which it needed an action of its policy, and the ticks without
    one in time.
    """

    timeliness: Any
    """The `vlagents_ray.chunking.timeliness.Timeliness` of the episode, which a reset replaces. The
    control loop adds the ticks at which it was too busy to call `act`.
    """


# ----- Finding out what an agent can do.


@runtime_checkable
class Forwards(InProcess, Protocol):
    """The agent stands in for another agent and has the same abilities: a wrapper, or the proxy of
    an agent in another process.
    """

    def forwarded(self, protocol: type[T]) -> T | None:
        """Return an object that has the other agent's ability, or None if the other agent lacks it.

        Args:
            protocol: The protocol of the ability.
        """


def ability(agent: Agent, protocol: type[T]) -> T | None:
    """Return the object that implements an ability of an agent.

    It takes about ten microseconds: call it when a session begins, not at each action.

    Args:
        agent: The agent.
        protocol: The protocol of the ability.

    Returns:
        The agent, if it has all members of the protocol and none of them is None; otherwise the
        result of its method `forwarded`, if it has one. None if the agent lacks the ability.
    """
    if has_members(agent, protocol):
        return cast(T, agent)
    if has_members(agent, Forwards):
        return cast(Forwards, agent).forwarded(protocol)
    return None


def has_members(agent: object, protocol: type) -> bool:
    """Return whether an object itself has all members of a protocol. Properties are not evaluated,
    since a property of a remote agent may wait for its server.
    """
    return all(inspect.getattr_static(agent, name, None) is not None for name in members(protocol))


@cache
def members(protocol: type) -> tuple[str, ...]:
    """Return the names of the methods and the attributes of a protocol."""
    names: dict[str, None] = {}
    for base in protocol.__mro__:
        if base in (Protocol, Generic, object):
            continue
        for name in (*vars(base), *inspect.get_annotations(base)):
            if not name.startswith("_"):
                names[name] = None
    return tuple(names)


def is_marked(protocol: type, mark: type) -> bool:
    """Return whether a protocol derives from a mark, `InProcess` or `Speculative`."""
    return mark in protocol.__mro__


@cache
def observation_arguments(protocol: type) -> Mapping[str, str]:
    """Return the argument that is an observation, for each method of a protocol.

    Args:
        protocol: The protocol.

    Returns:
        The name of the argument that is annotated as `Obs`, by the name of the method, without the
        methods that have no such argument.

    Raises:
        TypeError: A method has several such arguments, or an argument that contains observations,
            such as a list.
    """
    arguments = {}
    for name in members(protocol):
        method = getattr(protocol, name, None)
        if not inspect.isfunction(method):
            continue
        hints = get_type_hints(method)
        hints.pop("return", None)
        observing = [argument for argument, hint in hints.items() if _contains_obs(hint)]
        if not observing:
            continue
        if len(observing) > 1 or hints[observing[0]] is not Obs:
            raise TypeError(
                f"{protocol.__name__}.{name}: expected at most one argument with an observation, "
                f"annotated as Obs, got {observing}; make it one call for each observation"
            )
        arguments[name] = observing[0]
    return arguments


def bind(
    protocol: type, name: str, args: Sequence[Any], kwargs: Mapping[str, Any]
) -> inspect.BoundArguments:
    """Bind the arguments of a call to the parameters of a method; the first parameter, `self`, is
    None.

    Args:
        protocol: The protocol.
        name: One of its methods.
        args: The positional arguments of the call.
        kwargs: Its named arguments.

    Raises:
        TypeError: The arguments do not fit the method.
    """
    return _signature(protocol, name).bind(None, *args, **kwargs)


@cache
def _signature(protocol: type, name: str) -> inspect.Signature:
    return inspect.signature(getattr(protocol, name))


def _contains_obs(hint: Any) -> bool:
    """Return whether a type is `Obs` or contains it, as in `list[Obs]`."""
    return hint is Obs or any(_contains_obs(argument) for argument in get_args(hint))
