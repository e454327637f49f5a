"""How a worker comes to its agent: one of its own, or a connection to the policy's server."""

from __future__ import annotations

import functools
from collections.abc import Callable

from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.config import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.rollout import AgentFactory
from vlagents_ray.interface import Agent


def agents(config: EvalConfig, own: Callable[[], Agent] | None) -> AgentFactory:
    """What makes them in the worker: `own`, or connections. `ConfigError` if a policy to connect to has no URL."""
    if own is not None:
        return functools.partial(_own_agent, own)
    for policy in config.policies:
        if policy.url is None:
            raise ConfigError(
                f"policy {policy.name!r}: got no url, want that of its server, e.g. http://localhost:8000"
            )
    return functools.partial(_remote_agent, config)


def _own_agent(make: Callable[[], Agent], _policy: PolicyConfig) -> Agent:
    return make()


def _remote_agent(config: EvalConfig, policy: PolicyConfig) -> RemoteAgent:
    assert policy.url is not None  # noqa: S101 - looked at by `agents`
    return RemoteAgent(
        policy.url,
        transport=policy.transport,
        timeout_s=config.policy_timeout_s,
        connect_timeout_s=config.connect_timeout_s,
        codec=policy.codec,
        rank="simulation",
        resume=False,  # an episode that was interrupted is played again, so that its result depends on its key alone
    )
