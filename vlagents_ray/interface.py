"""Obs, Act and Agent: the interface of the paper "VLAgents: A Policy Server for Efficient VLA Inference".

A policy written as in the paper is served unchanged to many sessions at once:

    class Reach(Agent):
        def initialize(self):                 # once a replica: load the weights here
            self.model = load()
        def reset(self, obs, instruction, **kwargs):
            self.target = self.model.locate(obs.cameras["front"], instruction)
            return {}
        def act(self, obs):
            return Act(action=self.target - obs.state["xyzrpy"][:3])

Each session acts on its own copy of the initialized agent, which shares the weights
(see `vlagents_ray.serve.sessions`), so `self.target` above never mixes between robots.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vlagents_ray.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlagents_ray.contract import Contract

# Documented keys of `Obs.info` and `Act.info`; any other key the wire can carry is allowed too.
GOAL_IMAGE = "goal_image"  # (H, W, 3) uint8 RGB, for goal-conditioned policies
DEPTH = "depth"  # {camera: (H, W) float32, metres; or uint16, millimetres}
HIGH_RES = "high_res"  # {camera: (H, W, 3) uint8 RGB}, for the record only, never for the policy
SAMPLES = "samples"  # in an observation: how many draws from its action distribution the policy shall return, N
DISTRIBUTION = "distribution"  # in the Act: {"mean", "std": shaped as the action; "samples": (N, *action)} float32
CAPTURED = "captured_at"  # in an observation: when the sensors were read, s since 1970 (`time.time`)
DEADLINE = "deadline_ms"  # in an observation: no answer is wanted after this long; `RemoteAgent` gives it up then
# Real-time chunking (Black, Galliker & Levine 2025, https://arxiv.org/abs/2506.07339), in an observation: what the
# robot will do while the policy thinks. The first DELAY rows of LEFTOVER will have been executed when the answer
# comes, so the new chunk begins with them; the later ones are what it should go on from smoothly.
LEFTOVER = "leftover_actions"  # (H', D) float32: the current plan from this observation's tick on
DELAY = "delay_ticks"  # int: ticks until the answer comes, the longest measured of late
# In the Act of a chunk player:
SAFE = "safe"  # str: this is the safe action, and why; absent where it is the policy's
AGE = "age_ticks"  # int: ticks between the observation that the action was made from, and now
SILENT = "silent_s"  # float: for how long an answer has been waited for, retries included; 0.0 if none is


@dataclass(slots=True)
class Obs:
    """What a robot or an environment perceives at one moment.

    `state` names proprioception by part: `joints` (D,) rad, `xyzrpy` (6,) m and rad in the robot's
    base frame, `tquat` (7,) m and quaternion xyzw; with several arms `left/joints`, `right/joints`.
    """

    cameras: dict[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 RGB, upright
    gripper: float | None = None  # in [0, 1], 1 = open
    state: dict[str, np.ndarray] = field(default_factory=dict)  # (D,) float32
    info: dict[str, Any] = field(default_factory=dict)  # None, bool, int, float, str, bytes, array, list, dict


@dataclass(slots=True)
class Act:
    """What a policy wants done: one action, or a chunk of them to be executed in order."""

    action: np.ndarray  # (D,) or (H, D) float32, in the units of the contract's action
    done: bool = False  # the policy considers its task finished
    info: dict[str, Any] = field(default_factory=dict)  # as in `Obs.info`; `timing`: see `RemoteAgent.act`

    def rows(self) -> np.ndarray:
        """The action as a chunk, (H, D); a single action has H = 1."""
        return self.action if self.action.ndim == 2 else self.action[np.newaxis]


class Agent:
    """A policy. Local ones, the remote one and the chunk player all look like this."""

    Config: ClassVar[type | None] = None
    """Optional: a closed model (pydantic, `extra="forbid"`) of the settings; `__init__` gets an instance."""

    shared: ClassVar[tuple[str, ...]] = ()
    """Names of attributes that all sessions of a replica may share (weights, processors, clients)."""

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Build the agent from a deployment file's settings. An unknown key raises `ConfigError`."""
        try:
            if cls.Config is not None:
                return cls(cls.Config(**config))  # type: ignore[call-arg]
            inspect.signature(cls).bind(**config)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"policy {cls.__name__}: {error}") from error
        return cls(**config)

    def shared_objects(self) -> list[Any]:
        """What `shared` names; one that holds another agent adds that one's."""
        return [getattr(self, name, None) for name in self.shared]

    @property
    def contract(self) -> Contract | None:
        """What the policy needs and gives; None states nothing, so nothing is checked."""
        return None

    def initialize(self) -> None:
        """Load weights and everything heavy. Called once in a replica, before any `reset`."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode. `kwargs` may carry `seed` and `env`. Returns info about the episode.

        On a server this is called on a fresh copy of the initialized agent: nothing is left over
        from an earlier episode, whoever ran it.
        """
        return {}

    def observe(self, obs: Obs) -> None:
        """Remember an observation that no action is wanted for.

        Policies with a history override it: a session that had to begin again on another replica is
        `reset` with its first observation and then shown the last ones that it had acted on.
        """

    def act(self, obs: Obs) -> Act:
        """One action, or one chunk of actions, for this observation.

        An agent defines it, or `act_batch`, of which this is then a batch of one.
        """
        if type(self).act_batch is Agent.act_batch:
            raise NotImplementedError(f"{type(self).__name__} must define act(obs) -> Act, or act_batch")
        [act] = self.act_batch([obs], [self])
        if isinstance(act, Exception):
            raise act
        return act

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Actions for several sessions at once; adapters that can batch make it one forward pass.

        `self` is the initialized agent; `sessions[i]`, one of its session copies, holds the
        instruction, history and random generator that `obs[i]` belongs to. A session occurs at
        most once. What a session gets must not depend on its neighbours. An exception in place of
        an action fails that session's request alone; one that is raised fails them all.
        """
        acts: list[Act | Exception] = []
        for session, one in zip(sessions, obs, strict=True):
            try:
                acts.append(session.act(one))
            except Exception as error:  # noqa: BLE001 - handed to the session whose request failed
                acts.append(error)
        return acts

    def check_health(self) -> None:
        """Raise what keeps this agent from ever acting again, such as a lost device; a replica is then replaced.

        A server calls it every few seconds on the initialized agent, beside a batch that runs.
        """

    def close(self) -> None:
        """Give back what `initialize` took; a server calls it once, when the replica stops."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
