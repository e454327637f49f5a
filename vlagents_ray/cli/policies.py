"""The policies of an evaluation: at their URLs, or served for its duration."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator
from functools import cache
from typing import TYPE_CHECKING, Any

from vlagents_ray.cli.listing import require_packages
from vlagents_ray.cli.options import YAML_SUFFIXES
from vlagents_ray.cli.ray_session import quiet_ray
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import require_match
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import ConfigError, ContractMismatch
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, check, most_cpus, most_gpus
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.ray_tools.private import gpus_here
from vlagents_ray.ray_tools.session import joined
from vlagents_ray.serve.launch.deployment_file import (
    own_settings,
    read_deployment,
    stated_contract,
    together,
    with_settings,
)
from vlagents_ray.serve.launch.server import running_server, spread_over_gpus
from vlagents_ray.serve.models.checkpoints import STEP, resolved

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

_STARTING_S = 30.0  # time limit for a server at a URL


@contextlib.contextmanager
def served(config: EvalConfig, address: str | None = None, *, replica_per_gpu: bool = False) -> Iterator[EvalConfig]:
    """Serve the policies that are not at a URL for the length of the context.

    Yields:
        The evaluation with the URLs of all its policies.
    """
    with contextlib.ExitStack() as stack:
        stack.enter_context(quiet_ray(None))
        if address is not None:
            stack.enter_context(joined(address))
        config, parts = resolve_policies(config)
        # Raise errors before anything starts.
        if address is None:
            wanted = max(cell.worker.gpus for cell in cells(config))
            if wanted and wanted > (here := gpus_here()):  # Ray would never start these workers here
                raise ConfigError(
                    f"worker.gpus: a worker wants {wanted:g} GPUs, this machine has {here:g}; want less (0 draws in "
                    f"software), or the --address of a cluster that has them"
                )
            for part in parts.values():
                require_packages(part)
        policy_contract = cache(lambda application: stated_contract(parts[application]))
        for cell in cells(config) if config.real_robot is None else ():
            application = str(cell.policy.url).removeprefix("serve://")
            if application in parts and (env := known_contract(cell.env, cell.suite.env_options)) is not None:
                try:
                    require_match(policy_contract(application), env)
                except ContractMismatch as error:
                    raise ContractMismatch(f"{cell.policy.name!r} in {cell.env!r}: {error}") from None
        check(config)
        if parts and replica_per_gpu:
            parts = spread_over_gpus(parts, kept=config.workers * most_gpus(config))
        if parts:
            # Ray's CPUs are logical here: the requested number of workers must fit.
            cpus = max(os.cpu_count() or 1, math.ceil(config.workers * most_cpus(config)))
            stack.enter_context(running_server(together(parts), address=address, num_cpus=cpus, ingress=False))
        yield config


def resolve_policies(config: EvalConfig, *, ask: bool = True) -> tuple[EvalConfig, dict[str, ServeDeploySchema]]:
    """Find the names, URLs and deployments of the policies of an evaluation.

    Returns:
        The evaluation with names and URLs of its policies; and the deployments to start for it, by application.
    """
    parts: dict[str, ServeDeploySchema] = {}
    policies = [_resolve_policy(policy, parts, ask=ask) for policy in config.policies]
    return type(config).model_validate(config.model_dump(exclude_unset=True) | {"policies": policies}), parts


def _resolve_policy(policy: PolicyConfig, parts: dict[str, ServeDeploySchema], *, ask: bool) -> PolicyConfig:
    """Add name and URL to `policy`; add its deployment to `parts` unless a server has it."""
    url = policy.source if policy.source is not None and "://" in policy.source else policy.url
    if url is not None:
        found: dict[str, Any] = {"url": url, "source": None}
        if ask:  # a result belongs to the served policy, not to an address
            if policy.config:
                names = sorted(policy.config)
                raise ConfigError(f"policy {policy.name!r}: got {names}, but {url} has its settings already")
            with RemoteAgent(url, connect_timeout_s=_STARTING_S) as agent:  # its server may be starting
                said = agent.metadata
            name = policy.name if "name" in policy.model_fields_set else said["policy"]
            found |= {"name": name, "config": said.get("config", {}), "checkpoint": said.get("checkpoint")}
        return policy.model_copy(update=found)
    if policy.source is None:
        raise ConfigError(f"policy {policy.name!r}: want `source`, a policy to serve, or the `url` of a server")
    part = policy_deployment(policy, policy.source, step_follows=bool(policy.steps))
    own = own_settings(part.applications[0])
    name = policy.name if "name" in policy.model_fields_set else str(part.applications[0].args["policy"])
    application = re.sub(r"\W+", "-", name.rpartition(":")[2])
    if policy.steps and own.get(STEP) is None:  # record the pattern, not the deployment's own step
        part = with_settings(part, {STEP: policy.steps[0]}, steps=True)
    parts[application] = part
    found = {"name": name, "url": f"serve://{application}", "config": own, "checkpoint": resolved(own)}
    return policy.model_copy(update=found)


def policy_deployment(policy: PolicyConfig, source: str, *, step_follows: bool = False) -> ServeDeploySchema:
    """Read the deployment of `source` with the settings of `policy`; `step_follows` as in `read_deployment`."""
    of_name = {"config": policy.config} if policy.config and not source.endswith(YAML_SUFFIXES) else None
    read = read_deployment(source, of_name, step_follows=step_follows)
    return with_settings(read, policy.config, steps=bool(policy.steps), step_follows=step_follows)
