"""The policies of an evaluation: at their URLs, or served for its duration."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Any

from vlagents_ray.cli.console import out
from vlagents_ray.cli.listing import require_packages
from vlagents_ray.cli.options import YAML_SUFFIXES
from vlagents_ray.cli.ray_session import RESUME, exit_if_ray_is_lost, quiet_ray
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import require_match
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, PolicyConfig, check
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.workers.base import chosen_workers
from vlagents_ray.evaluate.workers.rollout import THREAD_VARIABLES
from vlagents_ray.interface import Agent
from vlagents_ray.policies.base.accelerator import VISIBLE
from vlagents_ray.ray_tools.private import gpus_here
from vlagents_ray.ray_tools.session import joined, variables
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import (
    IMPORT_PATH,
    Deployment,
    only_application,
    own_settings,
    read_deployment,
    stated_contract,
    together,
    with_settings,
)
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.serve.models.checkpoints import STEP, resolved

Agents = Mapping[str, Callable[[], Agent]]  # of policies that are played in this process, by name
_STARTING_S = 30.0  # time limit for a server at a URL


@contextlib.contextmanager
def served(
    config: EvalConfig, address: str | None = None, *, replica_per_gpu: bool = False
) -> Iterator[tuple[EvalConfig, Agents]]:
    """Serve the policies that are not at a URL for the length of the context, or let this process
    play them.

    Yields:
        The evaluation with its number of workers and the URLs of its policies; and, without
        workers, the agents of the policies that are not at a URL.
    """
    _require_cluster_workers(config, address)
    with contextlib.ExitStack() as stack:
        on_ray = address is not None or config.real_robot is not None or chosen_workers(config) > 0
        if on_ray:
            _enter_ray(stack, address)
        ready, parts = resolve_policies(config)
        local = None if on_ray else _local_policies(parts, config.workers)
        if not on_ray and local is None:
            _enter_ray(stack)
        # Raise errors before anything starts.
        if address is None:
            _require_resources(ready, parts)
        _require_fit(ready, parts)
        check(ready)
        if local is not None:
            if config.workers is None:
                out.print(
                    "a short evaluation, in this process without Ray (--workers 1 plays it in a "
                    "worker of Ray)"
                )
            yield _play_here(stack, ready, local)
            return
        ready = ready.model_copy(update={"workers": config.workers or 1})
        if parts:
            stack.enter_context(_on_ray(ready, parts, address, replica_per_gpu=replica_per_gpu))
        yield ready, {}


def planned_workers(
    config: EvalConfig, parts: Mapping[str, Deployment], address: str | None = None
) -> int:
    """Return the number of workers with which `served` would play `config`, whose policies became
    `parts`.

    Raises `ConfigError` where `served` does: `workers` is 0, and something needs Ray.
    """
    _require_cluster_workers(config, address)
    workers = chosen_workers(config)
    if workers or address is not None or _local_policies(parts, config.workers) is None:
        return workers or 1
    return 0


def _require_cluster_workers(config: EvalConfig, address: str | None) -> None:
    if config.workers == 0 and address is not None:
        raise ConfigError(
            "workers: got 0 with --address, want 1 or more in a cluster, or no --address"
        )


def _require_resources(config: EvalConfig, parts: Mapping[str, Deployment]) -> None:
    """Raise `ConfigError` or `MissingDependency` unless this machine has the GPUs and packages."""
    wanted = max(case.worker.gpus for case in plan_cases(config))
    if wanted and wanted > (here := gpus_here()):  # Ray would never start these workers here
        raise ConfigError(
            f"worker.gpus: a worker wants {wanted:g} GPUs, this machine has {here:g}; want less (0 "
            "draws in "
            f"software), or the --address of a cluster that has them"
        )
    for part in parts.values():
        require_packages(part)


def _require_fit(config: EvalConfig, parts: Mapping[str, Deployment]) -> None:
    """Raise `ContractMismatch` unless the policies that will be served fit their simulations."""
    policy_contract = cache(lambda application: stated_contract(parts[application]))
    for case in plan_cases(config) if config.real_robot is None else ():
        application = str(case.policy.url).removeprefix("serve://")
        if (
            application in parts
            and (env := known_contract(case.env, case.suite.env_options)) is not None
        ):
            require_match(
                policy_contract(application), env, f"{case.policy.name!r} in {case.env!r}: "
            )


def _play_here(
    stack: contextlib.ExitStack, config: EvalConfig, local: Mapping[str, partial[LocalPolicy]]
) -> tuple[EvalConfig, Agents]:
    """Prepare this process to play the policies, with the variables of workers and replicas, for
    the same results.
    """
    hidden = {} if any(one.args[0].resources.num_gpus for one in local.values()) else {VISIBLE: ""}
    stack.enter_context(
        variables(dict.fromkeys(THREAD_VARIABLES, str(config.worker.threads)) | hidden)
    )
    apps = {one.name: str(one.url).removeprefix("serve://") for one in config.policies}
    agents = {name: local[app] for name, app in apps.items() if app in local}
    own = [
        one.model_copy(update={"url": None}) if one.name in agents else one
        for one in config.policies
    ]
    return config.model_copy(update={"policies": own, "workers": 0}), agents


def _on_ray(
    config: EvalConfig,
    parts: Mapping[str, Deployment],
    address: str | None,
    *,
    replica_per_gpu: bool,
) -> contextlib.AbstractContextManager[Any]:
    """Return the context in which Ray serves the policies."""
    from vlagents_ray.evaluate.workers.cluster import most_cpus, most_gpus
    from vlagents_ray.serve.launch.server import running_server, spread_over_gpus

    workers = config.workers or 1
    if replica_per_gpu:
        parts = spread_over_gpus(parts, kept=workers * most_gpus(config))
    # Ray's CPUs are logical here: the requested number of workers must fit.
    cpus = max(os.cpu_count() or 1, math.ceil(workers * most_cpus(config)))
    return running_server(together(parts), address=address, num_cpus=cpus, ingress=False)


def _enter_ray(stack: contextlib.ExitStack, address: str | None = None) -> None:
    stack.enter_context(quiet_ray(None))
    stack.enter_context(exit_if_ray_is_lost(RESUME))
    if address is not None:
        stack.enter_context(joined(address))


def _local_policies(
    parts: Mapping[str, Deployment], workers: int | None
) -> dict[str, partial[LocalPolicy]] | None:
    """Return the policies for this process by application; None if Ray is to play them.

    Raises `ConfigError` if `workers` is 0 and Ray would have to.
    """
    found = {}
    for name, part in parts.items():
        app = only_application(name, part)
        args = (
            ServerArgs(**app.args)
            if app.import_path == IMPORT_PATH and not app.runtime_env
            else None
        )
        if workers == 0 and (args is None or args.environment.python):
            need = (
                "a runtime_env, or another import_path" if args is None else args.environment.python
            )
            raise ConfigError(
                f"workers: got 0, which plays in this Python, but {name!r} has {need}; want 1 or "
                "more"
            )
        if args is None or args.environment.python or (args.resources.num_gpus and workers is None):
            return None
        found[name] = partial(LocalPolicy, args, own_settings(app))
    return found


def resolve_policies(
    config: EvalConfig, *, ask: bool = True
) -> tuple[EvalConfig, dict[str, Deployment]]:
    """Return the evaluation with names and URLs of its policies, and the deployments to start,
    by application.
    """
    parts: dict[str, Deployment] = {}
    policies = [_resolve_policy(policy, parts, ask=ask) for policy in config.policies]
    return type(config).model_validate(
        config.model_dump(exclude_unset=True) | {"policies": policies}
    ), parts


def _resolve_policy(
    policy: PolicyConfig, parts: dict[str, Deployment], *, ask: bool
) -> PolicyConfig:
    """Add name and URL to `policy`; add its deployment to `parts` unless a server has it."""
    url = policy.source if policy.source is not None and "://" in policy.source else policy.url
    if url is not None:
        found: dict[str, Any] = {"url": url, "source": None}
        if ask:  # a result belongs to the served policy, not to an address
            if policy.config:
                names = sorted(policy.config)
                raise ConfigError(
                    f"policy {policy.name!r}: got {names}, but {url} has its settings already"
                )
            # Its server may be starting.
            with RemoteAgent(url, connect_timeout_s=_STARTING_S) as agent:
                said = agent.metadata
            name = policy.name if "name" in policy.model_fields_set else said["policy"]
            found |= {
                "name": name,
                "config": said.get("config", {}),
                "checkpoint": said.get("checkpoint"),
            }
        return policy.model_copy(update=found)
    if policy.source is None:
        raise ConfigError(
            f"policy {policy.name!r}: want `source`, a policy to serve, or the `url` of a server"
        )
    part = policy_deployment(policy, policy.source, step_follows=bool(policy.steps))
    own = own_settings(part.applications[0])
    name = (
        policy.name
        if "name" in policy.model_fields_set
        else str(part.applications[0].args["policy"])
    )
    application = re.sub(r"\W+", "-", name.rpartition(":")[2])
    if policy.steps and own.get(STEP) is None:  # record the pattern, not the deployment's own step
        part = with_settings(part, {STEP: policy.steps[0]}, steps=True)
    parts[application] = part
    found = {
        "name": name,
        "url": f"serve://{application}",
        "config": own,
        "checkpoint": resolved(own),
    }
    return policy.model_copy(update=found)


def policy_deployment(
    policy: PolicyConfig, source: str, *, step_follows: bool = False
) -> Deployment:
    """Read the deployment of `source` with the settings of `policy`; `step_follows` as in
    `read_deployment`.
    """
    of_name = (
        {"config": policy.config} if policy.config and not source.endswith(YAML_SUFFIXES) else None
    )
    read = read_deployment(source, of_name, step_follows=step_follows)
    return with_settings(read, policy.config, steps=bool(policy.steps), step_follows=step_follows)
