"""The agent that a worker plays with: a local one, or a connection to the policy's server."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.plan.config import EvalConfig, PolicyConfig
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.program import Program, code_of_class, files_named
from vlagents_ray.protocol.messages import RankName

AgentFactory = Callable[[PolicyConfig], Agent]


def agents(config: EvalConfig, own: Callable[[], Agent] | None, rank: RankName = "simulation") -> AgentFactory:
    """Return the factory that a worker calls: `own`, or one of connections with this `rank`.

    Raises:
        ConfigError: A policy to connect to has no URL.
    """
    if own is not None:
        return functools.partial(_own_agent, own)
    for policy in config.policies:
        if policy.url is None:
            raise ConfigError(
                f"policy {policy.name!r}: got no url, want that of its server, e.g. http://localhost:8000"
            )
    return functools.partial(_remote_agent, config, rank)


def _own_agent(make: Callable[[], Agent], _policy: PolicyConfig) -> Agent:
    return make()


def _remote_agent(config: EvalConfig, rank: RankName, policy: PolicyConfig) -> RemoteAgent:
    assert policy.url is not None  # noqa: S101 - `agents` has checked it
    return RemoteAgent(
        policy.url,
        transport=policy.transport,
        timeout_s=config.policy_timeout_s,
        connect_timeout_s=config.connect_timeout_s,
        codec=policy.codec,
        rank=rank,
        resume=False,  # an interrupted episode is played again, so that its result depends only on its key
    )


def factory_program(make: Callable[[], Agent]) -> Program:
    """Return the files of the module that defines `make`, and those that the arguments of a `partial` name."""
    settings: dict[str, Any] = {}
    if isinstance(make, functools.partial):
        settings = {**{str(i): value for i, value in enumerate(make.args)}, **make.keywords}
        make = make.func
    module = getattr(make, "__module__", None) or type(make).__module__
    return code_of_class(module) | files_named(settings)
