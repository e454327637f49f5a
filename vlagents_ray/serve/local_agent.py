"""A deployment's policy in this process, with the engine of a replica but without Ray."""

from __future__ import annotations

import importlib.metadata
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.base.program import SOFTWARE, Program
from vlagents_ray.protocol.messages import Priority, Reply, Request
from vlagents_ray.ray_tools.git_state import GitState
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.serve.python_env.child_agent import make_agent, version_of
from vlagents_ray.serve.requests import AwaitedReplies, IncomingMessage, PendingRequest
from vlagents_ray.serve.sessions import SessionFinder
from vlagents_ray.success import SuccessCurve, curves_in

_LOOK_S = 0.1  # period of the checks whether another thread has loaded a checkpoint, s


def build_engine(
    args: ServerArgs,
    config: Mapping[str, Any],
    finder: SessionFinder | None = None,
    *,
    threaded: bool = True,
) -> Engine:
    """Create the engine of a deployment, without loading its policy.

    Args:
        args: The settings, with `environment.process` decided.
        config: The settings of the policy, including the deployment's `user_config`.
        finder: Fetches sessions from other replicas; None if there are no other replicas.
        threaded: Whether a thread of the engine runs the policy.
    """
    settings = EngineSettings(
        max_batch_size=args.batch.max_size,
        patience=args.batch.patience,
        batch_sizes=args.batch.sizes or (),
        invariant=args.batch.invariant,
        session_limit=args.sessions.limit,
        session_idle_s=args.sessions.idle_s,
        version=version_of(args),
        check=args.dialects.require_fit,
        limits=args.limits.call_limits(),
        in_flight_bytes=args.limits.in_flight_bytes,
        threaded=threaded,
    )
    policy = PolicySource(partial(make_agent, args), config)
    return Engine(policy, settings, finder=finder)


def policy_metadata(
    args: ServerArgs, engine: Engine, code: GitState | None, program: Program
) -> dict[str, Any]:
    """Return the part of a server's metadata that describes its policy.

    Args:
        args: The settings of the server.
        engine: The engine of the policy.
        code: The git state of the policy's code, see `ServerArgs.code`.
        program: The digests of the policy's files, see `ServerArgs.code`.
    """
    contract, model = engine.contract, engine.model
    software = model.software_elsewhere()
    if software is not None:  # the policy has its own Python environment
        files = {name: value for name, value in program.items() if not name.startswith(SOFTWARE)}
        program = files | software
    return {
        "policy": args.policy,
        "checkpoint": model.checkpoint,
        "weights": model.weights,
        "devices": model.devices,
        "policy_version": engine.weights.describe(),
        "config": model.config,
        "wrappers": args.wrappers,
        "contract": None if contract is None else contract.to_json(),
        "continues_plans": model.continues_plans,
        "longest_prefix": model.longest_prefix,
        "version": importlib.metadata.version("vlagents-ray"),
        "code": None if code is None else code.to_json(),
        "program": program | model.files,
        "passes": model.passes,
        "batch_costs": engine.queue.window.describe_costs(),
    }


class LocalAgent(Agent):
    """One session of an engine in this process."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._session = uuid.uuid4().hex

    @property
    def contract(self) -> Contract | None:
        return self.engine.contract

    def reset(
        self,
        obs: Obs,
        instruction: str | None,
        *,
        contract: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> dict[str, Any]:
        """Begin an episode. If `contract` is set, it is first compared with the policy's contract,
        as a server does.
        """
        [reply] = self._replies(
            [self], [Request("reset", obs, instruction, kwargs, contract, priority="simulation")]
        )
        if reply.error is not None:
            raise reply.error
        return reply.info or {}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        """Compute the acts of several sessions together. The info of each result contains its
        `timing`.
        """
        requests = [Request("act", observation, priority="simulation") for observation in obs]
        results: list[Act | Exception] = []
        for reply in self._replies(sessions, requests):
            if reply.act is not None:
                reply.act.info["timing"] = reply.timing
            results.append(
                reply.error
                or reply.act
                or PolicyFailed("act: expected an action from the policy, got none")
            )
        return results

    def close(self) -> None:
        self._replies([self], [Request("close", priority="simulation")])

    def _replies(self, sessions: Sequence[Any], requests: Sequence[Request]) -> list[Reply]:
        """Return the reply to one request of each session."""
        message, awaited = IncomingMessage("local"), AwaitedReplies()
        message.expect(len(requests), awaited)
        pairs = zip(sessions, requests, strict=True)
        self.engine.intake.submit(
            [
                PendingRequest(session._session, request, message, Priority.SIMULATION, index=index)
                for index, (session, request) in enumerate(pairs)
            ]
        )

        while not self.engine.settings.threaded and not awaited.replies.done():
            taken = self.engine.queue.take()
            if taken is None:
                break
            self.engine.runner.run(taken)
            if not taken.batch:
                self.engine.queue.poller.poll(_LOOK_S)
        return awaited.replies.result()


class LocalPolicy(LocalAgent):
    """A deployment's policy as an agent. `sessions` opens more sessions of the policy."""

    def __init__(
        self, args: ServerArgs, config: Mapping[str, Any], *, threaded: bool = False
    ) -> None:
        """Create the agent; `initialize` loads the policy.

        Args:
            args: The settings. A policy with its own Python environment runs in a child process.
            config: The settings of the policy, including the deployment's `user_config`.
            threaded: Whether a separate thread runs the policy, in batches of sessions that act at
                the same time. By default, the caller's thread runs the policy, so that a debugger
                can stop in it.
        """
        environment = args.environment.model_copy(update={"process": "child"})
        local_args = args.model_copy(update={"environment": environment})
        super().__init__(build_engine(local_args, config, threaded=threaded))
        self._args, self._code = args, args.code()

    @property
    def metadata(self) -> dict[str, Any]:
        """The metadata of the policy, as `RemoteAgent.metadata`."""
        return policy_metadata(self._args, self.engine, *self._code)

    @property
    def longest_prefix(self) -> int:
        """The largest number of rows of the executed plan with which a chunk begins; see
        `BeginsWithPlan`.
        """
        return self.engine.model.longest_prefix

    @property
    def success_curves(self) -> Sequence[SuccessCurve]:
        """The measured success of the policy's checkpoint; see `HasSuccess`."""
        return curves_in(self.metadata)

    def initialize(self) -> None:
        self.engine.start()

    def sessions(self, n: int) -> list[LocalAgent]:
        """Open `n` more sessions, for `act_batch` of this agent. The caller must close each
        session.
        """
        return [LocalAgent(self.engine) for _ in range(n)]

    def close(self) -> None:
        self.engine.close()
