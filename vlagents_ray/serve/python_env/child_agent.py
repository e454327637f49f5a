"""The agent of a replica: the policy itself, or a proxy for a policy that runs in a
child process.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, ClassVar, TypeVar, cast

from vlagents_ray.abilities import InProcess, Prepares, is_marked
from vlagents_ray.contract import Contract
from vlagents_ray.errors import NotReset, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base.program import Program
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.ability_call import AbilityCall, is_method, name_of
from vlagents_ray.serve.models.loaded_model import ComputesElsewhere, GpuWork
from vlagents_ray.serve.python_env.child_connection import ChildConnection, StoredObservation
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import ChildProcess, ChildProgram
from vlagents_ray.serve.python_env.child_weights import ChildWeights
from vlagents_ray.serve.weights import HoldsWeights, ModelWeights

T = TypeVar("T")


def make_agent(args: ServerArgs, config: Mapping[str, Any]) -> Agent:
    """Build the policy with the settings `config`, or the proxy for a child process, without
    loading it.

    `args.environment.process` must be decided, see `probe.with_process`.
    """
    environment = args.environment
    if environment.python is not None and environment.process == "child":
        settings = Settings(
            policy=args.policy,
            config=dict(config),
            batch=args.batch.max_size,
            version=version_of(args),
            wrappers=args.wrappers,
            invariant=bool(args.batch.invariant),
        )
        return ChildAgent(ChildProgram(environment.python, settings, environment.env_vars))
    return build_agent(args.policy, config, args.wrappers)


def version_of(args: ServerArgs) -> str:
    """Return a text that is equal in replicas between which sessions can move.

    The text covers the policy, its wrappers and its environment, since a pickle is valid only in
    the environment that created it.
    """
    return json.dumps([args.policy, args.wrappers, args.environment.model_dump()], sort_keys=True)


class ChildAgent(Agent, HoldsWeights, ComputesElsewhere):
    """Proxy for the policy in a child process; each copy of the proxy is one session of the policy,
    which moves to another child by pickling.
    """

    shared: ClassVar[tuple[str, ...]] = ("_program", "_connection")

    def __init__(self, program: ChildProgram) -> None:
        """Create the proxy; `initialize` starts the child process."""
        self._program = program
        self._connection: ChildConnection | None = None  # None until `initialize`
        self._session: str | None = None  # None until `reset`

    @property
    def child(self) -> ChildConnection:
        """The connection to the child process; raises `PolicyUnavailable` before `initialize`."""
        if self._connection is None:
            raise PolicyUnavailable("the policy's process has not started")
        return self._connection

    @property
    def contract(self) -> Contract | None:
        return None if self._connection is None else self._connection.policy.contract

    def initialize(self) -> None:
        process = ChildProcess(self._program)
        try:
            self._connection = ChildConnection(process, process.wait_until_loaded())
        except BaseException:
            process.close()
            raise
        self.weights_id = self._connection.policy.weights

    def model_weights(
        self, busy: threading.Lock, digest: str, model: tuple[str, str]
    ) -> ModelWeights:
        return ChildWeights(self, self.child, busy, digest, model)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if self._session is None:
            self._session = self.child.open_session()
        return self._ask(Request("reset", obs, instruction, kwargs)).info or {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Send the observations in one message, except observations that the child has already
        stored; return the action or the error of each.
        """
        requests = []
        for session, session_obs in zip(sessions, obs, strict=True):
            if not isinstance(session, ChildAgent):
                continue
            request = Request("act", session_obs, session=session._session or "")
            stored = session_obs.prepared
            # A stored observation cannot be used for a row that pads the batch, which has the
            # observation of another session, or if the caller uses the observation in a second act.
            if isinstance(stored, StoredObservation) and stored.waits_for(
                self.child, request.session
            ):
                request.obs, request.prepared = None, stored.number
                stored.is_named = True
            requests.append(request)

        missing = PolicyFailed("act: expected an action from the policy's process, got none")
        return [reply.error or reply.act or missing for reply in self.child.call(requests)]

    def forwarded(self, protocol: type[T]) -> T | None:
        """Return an ability of the policy in the child, whose arguments and results are sent.

        The child itself uses an ability whose values cannot be sent (`InProcess`): it prepares the
        observations that this process sends in advance, replaces weights, and checks its health.
        """
        if protocol is Prepares and self._connection is not None and self.child.has(Prepares):
            return cast(T, _SendsAhead(self))
        is_loaded = self._connection is not None
        if is_marked(protocol, InProcess) or not is_loaded or not self.child.has(protocol):
            return None
        return cast(T, _AbilityInChild(self, protocol))

    def use_ability(self, call: AbilityCall, obs: Obs | None) -> Any:
        """Use an ability of this session's agent in the child, or of the loaded policy before the
        first reset, and return the result.

        Raises:
            NotReset: The call has an observation, but there is no session.
        """
        if self._session is not None:
            return (self._ask(Request("call", obs, kwargs=asdict(call))).info or {}).get("result")
        if obs is not None:
            raise NotReset(f"{call.member} before reset; reset first")
        return self.child.call_in_background("ability", **asdict(call))["result"]

    def gpu_memory(self) -> dict[str, int]:
        return self.child.gpu_memory()

    def software(self) -> Program:
        return self.child.policy.software

    def gpu_work(self) -> GpuWork:
        return self.child.gpu_work()

    def check_health(self) -> None:
        """Raise `PolicyUnavailable` if the child has ended, which it does if its policy is
        unhealthy.
        """
        self.child.process.require_alive()

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()

    def _ask(self, request: Request) -> Reply:
        request.session = self._session or ""
        return self.child.ask(request)

    def __getstate__(self) -> dict[str, Any]:
        """Export the session's state from the child, which removes the session there."""
        moved = None if self._session is None else self._ask(Request("export")).info
        return {"program": self._program, "connection": self._connection, "moved": moved}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._program = state["program"]
        self._connection = state["connection"]
        self._session = None
        if state["moved"] is not None:
            self._session = self.child.open_session()
            self._ask(Request("adopt", kwargs=state["moved"]))

    def __del__(self) -> None:
        session = getattr(self, "_session", None)  # missing if `__init__` did not run
        if session is not None:
            self.child.drop(session)


class _SendsAhead:
    """The ability `Prepares` of a session whose policy runs in a child process.

    The child stores each observation and begins to prepare it, while the policy acts.
    """

    def __init__(self, agent: ChildAgent) -> None:
        self._agent = agent

    def prepare(self, obs: Obs) -> StoredObservation | None:
        """Send an observation to the child, and return a reference to it there; None if the child
        rejects the observation. The act then fails with the reason.
        """
        session = self._agent._session
        try:
            return None if session is None else self._agent.child.store(session, obs)
        except VLAgentsError:
            return None


class _AbilityInChild:
    """An ability of the policy in a child process, with the members of its protocol."""

    def __init__(self, agent: ChildAgent, protocol: type) -> None:
        self._agent, self._protocol = agent, protocol

    def __getattr__(self, name: str) -> Any:
        if not is_method(self._protocol, name):
            return self._agent.use_ability(AbilityCall(name_of(self._protocol), name), None)

        def call(*args: Any, **kwargs: Any) -> Any:
            return self._agent.use_ability(
                *AbilityCall.from_arguments(self._protocol, name, args, kwargs)
            )

        return call
