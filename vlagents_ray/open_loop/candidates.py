"""Policies that are asked what they would have done: in this process, or on a server."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import partial
from typing import Any

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.launch.deployment_file import own_settings, policy_application
from vlagents_ray.serve.python_env.child_agent import make_agent, version_of
from vlagents_ray.serve.python_env.probe import with_process

Sessions = Callable[[], Agent]
"""Opens a session; each is closed by who asked for it."""


class LocalAgent(Agent):
    """One session of an engine in this process."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._session = uuid.uuid4().hex

    @property
    def contract(self) -> Contract | None:
        return self._engine.contract

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return self._ask(Request("reset", obs, instruction, kwargs, rank="simulation")).info or {}

    def act(self, obs: Obs) -> Act:
        act = self._ask(Request("act", obs, rank="simulation")).act
        if act is None:
            raise PolicyFailed("act: the policy answered without an action")
        return act

    def close(self) -> None:
        self._ask(Request("close", rank="simulation"))

    def _ask(self, request: Request) -> Reply:
        answer: Future[Reply] = Future()
        self._engine.submit(self._session, request, answer.set_result)
        reply = answer.result()
        if reply.error is not None:
            raise reply.error
        return reply


@contextmanager
def candidate(source: str) -> Iterator[Sessions]:
    """Load a policy for the time of the context.

    Args:
        source: The URL of a server; or a registered name or a deployment file, which is loaded in this process.

    Yields:
        Opens its sessions, which share its batches.
    """
    if "://" in source:
        yield partial(RemoteAgent, source, rank="simulation", codec="exact")
        return
    application = policy_application(source)
    args = ServerArgs(**application.args)
    args = args.model_copy(update={"environment": with_process(args.environment)})
    engine = Engine(
        args.checkpoints.of(partial(make_agent, args), own_settings(application)),
        max_batch_size=args.batch.max_size,
        patience=args.batch.patience,
        batch_sizes=args.batch.sizes or (),
        version=version_of(args),
        limits=args.limits.call_limits(),
    )
    try:
        engine.start()
        yield partial(LocalAgent, engine)
    finally:
        engine.close()
