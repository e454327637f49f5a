"""The agent of a replica: the policy itself, or a proxy for one that runs in a child process."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from vlagents_ray.contract import Contract
from vlagents_ray.errors import NotTrainable, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.wrapper import build_agent
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import Child


def make_agent(args: ServerArgs, config: Mapping[str, Any]) -> Agent:
    """Build the policy with these settings, or the proxy for a child process, without loading it.

    Args:
        args: The settings of the server; `environment.process` must be decided, see `probe.with_process`.
        config: The settings of the policy.
    """
    environment = args.environment
    if environment.python is not None and environment.process == "child":
        settings = Settings(args.policy, dict(config), args.batch.max_size, version_of(args), args.wrappers)
        return ChildAgent(Child(environment.python, settings, environment.env_vars))
    return build_agent(args.policy, config, args.wrappers)


def version_of(args: ServerArgs) -> str:
    """Return a text that is equal in replicas between which sessions can move.

    It covers policy, wrappers and environment, since pickles of one environment are valid in no other.
    """
    return json.dumps([args.policy, args.wrappers, args.environment.model_dump()], sort_keys=True)


class ChildAgent(Agent):
    """Proxy for the policy in a child process; a copy is one of its sessions and moves to another child by pickling."""

    shared: ClassVar[tuple[str, ...]] = ("_child",)

    def __init__(self, child: Child) -> None:
        self._child = child
        self._session: str | None = None  # None until `reset`

    @property
    def contract(self) -> Contract | None:
        return self._child.contract

    def initialize(self) -> None:
        self._child.start()
        self.weights_id = self._child.weights

    def parameters(self) -> dict[str, Any]:
        raise NotTrainable(
            "the policy runs in a child process, with a Python environment of its own, where its weights are out of "
            "reach; with the Python minor and the Ray of the cluster in that environment, `environment: {process: "
            "replica}` lets the replica itself run there"
        )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        if self._session is None:
            self._session = self._child.open_session()
        return self._ask(Request("reset", obs, instruction, kwargs)).info or {}

    def observe(self, obs: Obs) -> None:
        self._ask(Request("observe", obs))

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        requests = [
            Request("act", one, session=session._session or "")
            for session, one in zip(sessions, obs, strict=True)
            if isinstance(session, ChildAgent)
        ]
        none = PolicyFailed("act: the policy's process answered without an action")
        return [reply.error or reply.act or none for reply in self._child.call(requests)]

    @property
    def continues_plans(self) -> bool:
        return self._child.continues_plans

    def check_health(self) -> None:
        self._child.require_alive()

    def close(self) -> None:
        self._child.close()

    def _ask(self, request: Request) -> Reply:
        request.session = self._session or ""
        [reply] = self._child.call([request])
        if reply.error is not None:
            raise reply.error
        return reply

    def __getstate__(self) -> dict[str, Any]:
        """Export the session's state from the child, which removes the session there."""
        moved = None if self._session is None else self._ask(Request("export")).info
        return {"child": self._child, "moved": moved}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._child, self._session = state["child"], None
        if state["moved"] is not None:
            self._session = self._child.open_session()
            self._ask(Request("adopt", kwargs=state["moved"]))

    def __del__(self) -> None:
        if (session := getattr(self, "_session", None)) is not None:
            self._child.close_session(session)
