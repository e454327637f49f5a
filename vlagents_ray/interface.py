"""Obs, Act and Agent: the interface of the paper "VLAgents: A Policy Server for Efficient VLA
Inference".

The server runs a policy that is written as in the paper for many sessions at once:

    class Reach(Agent):
        def initialize(self):                 # called once in each replica: load the weights here
            self.model = load()
        def reset(self, obs, instruction, **kwargs):
            self.target = self.model.locate(obs.cameras["front"], instruction)
            return {}
        def act(self, obs):
            return Act(action=self.target - obs.state["xyzrpy"][:3])

Each session has its own copy of the initialized agent, and all copies share the weights (see
`vlagents_ray.serve.sessions`). So `self.target` above belongs to only one robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vlagents_ray.errors import ConfigError, NotTrainable
from vlagents_ray.settings import require_arguments, wrong_settings
from vlagents_ray.weights.trainable import named_values, set_values

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlagents_ray.contract import Contract

# The keys of `Obs.info` and `Act.info` that this package interprets. Other keys are also allowed,
# with values of the types listed at `Obs.info`.
GOAL_IMAGE = "goal_image"  # (H, W, 3) uint8 RGB, for goal-conditioned policies
# In an observation: N, the number of samples from the policy's action distribution that the Act
# returns.
SAMPLES = "samples"
# In the Act: {"mean", "std": shaped as the action; "samples": (N, *action)} float32. For each name
# in WANT, the dict also has an array with the value of every sample, whose first dimension is N.
DISTRIBUTION = "distribution"
# In an observation: names from `Contract.behaviour`; the Act returns their values with the action.
WANT = "want"
# In the Act: {name: a number, or a number for each row or token}, e.g. the action's "logprob",
# nats.
BEHAVIOUR = "behaviour"
# In an observation: the time at which the first of its sensors was read, s since 1970
# (`time.time`).
CAPTURED = "captured_at"
# In an observation: the time after which `RemoteAgent` abandons the request, ms.
DEADLINE = "deadline_ms"
# The next two keys are in an observation for real-time chunking (Black, Galliker & Levine 2025,
# https://arxiv.org/abs/2506.07339). When the answer arrives, the first DELAY rows of LEFTOVER have
# been executed. The new chunk begins with these rows, and is computed to continue the other rows of
# LEFTOVER.
LEFTOVER = "leftover_actions"  # (H', D) float32: the current plan, from this observation's tick
# int: the expected number of ticks until the answer arrives, at most the number of rows of
# LEFTOVER. 0 if no row will be executed, or if the delay is unknown; the plan is then not read.
DELAY = "delay_ticks"
# In an observation, float: the time that the server may take to answer, from the arrival of the
# request, ms. It is 0 if the robot has no rows left.
SLACK = "slack_ms"
# In an observation, [int, int]: the number of ticks since the last request at which the robot
# needed an action of the policy, and the number of these ticks without one (starved ticks).
TICKS = "ticks"
# In an observation, float: the age of the last executed action of the policy, ms; absent if none
# was executed since the last request.
EXECUTED_AGE = "executed_age_ms"
# In the Act of a server under load, float: how long the robot should wait after this answer before
# its next request, ms.
REPLAN = "replan_ms"
# In the Act of a policy that was trained to continue given rows, int: the number of rows of
# LEFTOVER with which its chunk begins. If the robot has executed more rows when the chunk arrives,
# the chunk is dropped, since it continues from a pose that the robot has left.
GIVEN = "given_rows"
# In an observation, (N, D): the actions since the last request that the robot executed and that the
# policy did not choose.
EXECUTED = "executed_actions"
# In the Act of a served policy: its weights, {"version": int, "fingerprint": str}. Version 0 is the
# loaded checkpoint.
POLICY = "policy"
# The next keys are in the Act of a chunk player.
SAFE = "safe"  # str: the reason why this is the safe action; absent if the action is the policy's
CAUSE = "safe_cause"  # str: the kind of that reason, see `vlagents_ray.chunking.fallback.Cause`
INTERVENTION = "intervention"  # True if the action is an operator's, else absent
# (D,) float32: the policy's action that an operator's action replaced; absent if unknown.
WANTED = "policy_action"
AGE = "age_ticks"  # int: ticks since the observation from which the action was computed
PLANNED = "planned"  # (H, D) float32: the chunk that contains the action
# int: the number of that chunk in the episode, and the index of the action's row.
CHUNK, ROW = "chunk", "row"
# float: the age of the observation in ms, from its capture until the player returned the action.
AGE_MS = "age_ms"
# float: seconds since the oldest unanswered request was first sent; 0.0 if all are answered.
SILENT = "silent_s"
# bool: whether an answer of the policy had a row for this tick; absent if the robot needed no
# action of the policy (see `vlagents_ray.chunking.timeliness`).
IN_TIME = "in_time"
OF_THE_LOOP = (SAFE, CAUSE, INTERVENTION, WANTED, AGE, PLANNED, CHUNK, ROW, AGE_MS, SILENT, IN_TIME)
"""The keys of `Act.info` that only a chunk player on the robot writes, and that a control loop
reads.
"""


@dataclass(slots=True)
class Obs:
    """An observation: the sensor readings of a robot or an environment at one moment.

    `state` contains the parts of the proprioception by name: `joints` (D,) rad; `xyzrpy` (6,) m and
    rad in the robot's base frame; `tquat` (7,) m and quaternion xyzw. If a robot has several arms,
    the names have a prefix: `left/joints`, `right/joints`. With one camera: `Obs(cameras={"front":
    image}, gripper=1.0, state={"joints": joints})`.
    """

    cameras: dict[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 RGB, upright
    gripper: float | None = None  # in [0, 1], 1 = open
    state: dict[str, np.ndarray] = field(default_factory=dict)  # (D,) float32
    # The values are None, bool, int, float, str, bytes, arrays, or lists and dicts of these.
    info: dict[str, Any] = field(default_factory=dict)
    # The result of `Prepares.prepare` (`vlagents_ray.abilities`), which a server sets; or None.
    prepared: Any = field(default=None, repr=False, compare=False)


@dataclass(slots=True)
class Act:
    """A policy's answer: one action, or a chunk of actions to be executed in order."""

    # (D,), or (H, D) for a chunk, float32, in the units of the contract's action.
    action: np.ndarray
    done: bool = False  # the policy considers its task finished
    # The values have the types of `Obs.info`; `RemoteAgent.act` describes `timing`.
    info: dict[str, Any] = field(default_factory=dict)

    def rows(self) -> np.ndarray:
        """Return the action as a chunk, (H, D); a single action has H = 1."""
        return self.action if self.action.ndim == 2 else self.action[np.newaxis]


class Agent:
    """The interface of a policy, which local policies, `RemoteAgent` and `ChunkPlayer` implement.

    A subclass defines `act`, or `act_batch` if one forward pass can serve several sessions.
    Everything else has a default. An agent that can do more, such as prepare observations or load
    new weights, defines the methods of a protocol in `vlagents_ray.abilities`.
    """

    Config: ClassVar[type | None] = None
    """Optional: a pydantic model of the settings, with `extra="forbid"`; `__init__` receives an
    instance of it.
    """

    shared: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes (weights, processors, clients) that all sessions of a replica share.
    """

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Build the agent from a deployment file's settings.

        Args:
            config: The values under `config` in the deployment file, by setting.

        Raises:
            ConfigError: A setting is unknown, missing, or has a wrong value.
        """
        if cls.Config is None:
            require_arguments(f"policy {cls.__name__}", cls, config)
            return cls(**config)
        try:
            return cls(cls.Config(**config))  # type: ignore[call-arg]
        except (TypeError, ValueError) as error:
            if isinstance(error, ValueError):
                message = wrong_settings(error, cls.Config, "--set")
            else:
                message = str(error)
            raise ConfigError(f"policy {cls.__name__}: {message}") from error

    def shared_objects(self) -> list[Any]:
        """Return the objects that `shared` names; an agent that wraps another agent adds the other
        agent's shared objects.
        """
        return [getattr(self, name, None) for name in dict.fromkeys(self.shared)]

    @property
    def contract(self) -> Contract | None:
        """The inputs that the policy needs and the actions that it returns; None to check
        nothing.
        """
        return None

    def initialize(self) -> None:
        """Load the weights and do all other slow preparation; a server calls this once in each
        replica, before any `reset`.
        """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode.

        A server calls this on a fresh copy of the initialized agent, which contains no state of an
        earlier episode.

        Args:
            obs: The first observation of the episode.
            instruction: The task in words; None if it has none.
            kwargs: Options: `seed` (int) is the seed of the session's random generator. An
                evaluation also passes `env`, the name of its environment.

        Returns:
            Information about the episode, with values of the types that `Obs.info` may have; often
            empty.
        """
        return {}

    def act(self, obs: Obs) -> Act:
        """Compute an action, or a chunk of actions.

        An agent defines this method or `act_batch`. The default implementation calls `act_batch`
        with a batch of one.

        Args:
            obs: The observation to act on; it must not be changed.

        Returns:
            The action, (D,) float32, or a chunk of them, (H, D), in arrays that later calls do not
            change.
        """
        if type(self).act_batch is Agent.act_batch:
            raise NotImplementedError(
                f"{type(self).__name__} must define act(obs) -> Act, or act_batch"
            )
        [act] = self.act_batch([obs], [self])
        if isinstance(act, Exception):
            raise act
        return act

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Compute the actions of several sessions at once, in one forward pass where the model can
        batch.

        `self` is the initialized agent. The action of a session must not depend on the other
        sessions in the batch.

        Args:
            obs: One observation for each session.
            sessions: The sessions' copies of the agent, which hold their instruction, history and
                random generator; `obs[i]` belongs to `sessions[i]`, and no session occurs twice.

        Returns:
            One action, or chunk of actions, for each session, in their order. If the list contains
            an exception in place of an action, only the request of that session fails; if an
            exception is raised, the whole batch fails.
        """
        acts: list[Act | Exception] = []
        for session, session_obs in zip(sessions, obs, strict=True):
            try:
                acts.append(session.act(session_obs))
            except Exception as error:  # noqa: BLE001 - returned to the session whose request failed
                acts.append(error)
        return acts

    def close(self) -> None:
        """Free the resources that `initialize` acquired; a server calls this once, when the
        replica stops.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class TrainableAgent(Agent):
    """An agent whose weights a learner trains and pushes into a running server.

    A subclass names the attribute with the weights; see `vlagents_ray.abilities.Trainable`.
    """

    trainable: ClassVar[str | None] = None
    """The name of the attribute that a learner trains.

    It holds a torch module, or nested dicts and lists of arrays and modules, and is shared by all
    sessions. "a.b" is the attribute b of the attribute a; all of a is then shared.
    """

    def shared_objects(self) -> list[Any]:
        """Return the objects that `shared` and `trainable` name."""
        objects = super().shared_objects()
        if self.trainable is not None:
            name = self.trainable.partition(".")[0]
            if name not in self.shared:
                objects.append(getattr(self, name, None))
        return objects

    def parameters(self) -> dict[str, Any]:
        """Return references to the values that a learner trains, by name.

        Names of a torch module are those of its `state_dict`; those of nested dicts are their keys,
        joined with "/".

        Raises:
            NotTrainable: The agent has no trainable parameters, i.e. `trainable` is None.
        """
        return named_values(self._trainable())

    def load_parameters(self, values: Mapping[str, Any]) -> None:
        """Replace the parameters, for all later actions; a server calls this between two batches.

        It replaces the values in `trainable` by reference. Values on a GPU are copied to the
        addresses of the old values instead, so that CUDA graphs stay valid. An agent that derives
        other values from its parameters must override this method, call it, and compute the derived
        values again.

        Args:
            values: A value for each name of `parameters`, of the same shape, type and device. They
                have been checked, and do not change later; the agent must not change them either.

        Raises:
            NotTrainable: The agent has no trainable parameters, i.e. `trainable` is None.
        """
        set_values(self._trainable(), values)

    def _trainable(self) -> Any:
        if self.trainable is None:
            raise NotTrainable(
                f"{type(self).__name__}: names no parameters to train; set `trainable` to the name "
                "of the attribute with its torch module or its dicts of arrays"
            )
        try:
            return attrgetter(self.trainable)(self)
        except AttributeError as error:
            raise NotTrainable(
                f"trainable: {error}; call initialize() first, or correct the name"
            ) from error


def copied(obs: Obs) -> Obs:
    """Copy an observation with its arrays, since a caller may reuse their memory for the next
    observation.
    """
    return Obs(
        {name: np.array(image) for name, image in obs.cameras.items()},
        obs.gripper,
        {name: np.array(values) for name, values in obs.state.items()},
        _copied(obs.info),
    )


def _copied(value: Any) -> Any:
    """Copy arrays at any depth of dicts and lists."""
    if isinstance(value, np.ndarray):
        return np.array(value)
    if isinstance(value, dict):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_copied(item) for item in value]
    return value
