"""The agent of a replica: the policy itself, or what stands for one that runs in a process of its own."""

from __future__ import annotations

import json

from vlagents_ray.interface import Agent
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.environments.child import Child, ChildAgent
from vlagents_ray.serve.environments.host import Settings


def make_agent(args: ServerArgs) -> Agent:
    """Built, not loaded. By now `environment.process` says which of the two it is."""
    environment = args.environment
    if environment.python is not None and environment.process == "child":
        settings = Settings(args.policy, args.config, args.batch.max_size, version_of(args))
        return ChildAgent(Child(environment.python, settings, environment.env_vars))
    agent: Agent = policy_class(args.policy).from_config(args.config)
    return agent


def version_of(args: ServerArgs) -> str:
    """Sessions move between replicas in which it is equal: pickles of one environment are for no other."""
    return json.dumps([args.policy, args.config, args.environment.model_dump()], sort_keys=True)
