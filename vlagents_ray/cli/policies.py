"""The policies of an evaluation, which are at URLs or are served while the evaluation runs."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

from vlagents_ray.cli.console import out
from vlagents_ray.cli.listing import require_packages
from vlagents_ray.cli.ray_session import RESUME, exit_if_ray_is_lost, quiet_ray
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import require_match
from vlagents_ray.envs.base import known_contract
from vlagents_ray.errors import ConfigError, MalformedMessage, shown
from vlagents_ray.evaluate import EvalConfig, PolicyConfig
from vlagents_ray.evaluate.driver import CheckpointSwaps
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.resolved import (
    ResolvedPlan,
    chosen_workers,
    may_use_cluster,
    require_installed,
    resolve,
)
from vlagents_ray.evaluate.run import check_results
from vlagents_ray.evaluate.workers.rollout import THREAD_VARIABLES
from vlagents_ray.interface import Agent
from vlagents_ray.overrides import YAML_SUFFIXES
from vlagents_ray.policies.base.accelerator import VISIBLE
from vlagents_ray.policies.base.checkpoint import CHECKPOINT, CHECKPOINT_STEP, checkpoint_name
from vlagents_ray.ray_tools.private import gpus_here
from vlagents_ray.ray_tools.session import joined, variables
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import (
    IMPORT_PATH,
    Deployment,
    declared_contract,
    only_application,
    our_apps,
    own_settings,
    read_deployment,
    together,
    with_settings,
    with_user_config,
)
from vlagents_ray.serve.local_agent import LocalPolicy

Agents = Mapping[str, Callable[..., Agent]]  # policies that run in this process, by name
_STARTING_S = 30.0  # time limit for a server at a URL
# In passes of 2 or 4 rows on a CPU, the places of LeRobot's ACT, Diffusion and VQ-BeT differ in
# their last bits; in passes of 8 and 16 rows, those of no measured policy do.
_LEAST_ROWS = 8


@dataclass(frozen=True, slots=True)
class Served:
    """An evaluation whose policies are served, or can be created in this process."""

    plan: ResolvedPlan
    # Without workers, the agents of the policies that are not at a URL.
    agents: Agents = field(default_factory=dict)
    # The servers of the policies that are not at a URL; None if there are none.
    swaps: CheckpointSwaps | None = None


@contextlib.contextmanager
def served(
    config: EvalConfig,
    address: str | None = None,
    *,
    replica_per_gpu: bool = False,
    rows: int | None = None,
) -> Iterator[Served]:
    """Resolve an evaluation and, within the context, serve its policies that are not at a URL, or
    run them in this process.

    Args:
        config: The evaluation.
        address: A running Ray cluster; None starts one on this machine if Ray is needed.
        replica_per_gpu: Whether each policy has a replica on each GPU of the cluster.
        rows: The number of rows of each forward pass, with `batch.invariant`; None: as the
            deployments say, see `with_full_passes`.

    Yields:
        The plan with its policies.
    """
    _require_cluster_workers(config, address)
    with contextlib.ExitStack() as stack:
        # Join Ray before the policies are resolved, since a policy may be served in Ray's cluster.
        on_ray = address is not None or config.real_robot is not None
        if not on_ray:
            on_ray = chosen_workers(config, plan_cases(config)) > 0
        if on_ray:
            _require_simulators(config, address)
            _enter_ray(stack, address)

        ready, deployments = resolve_policies(config)
        if config.real_robot is None:
            sessions = _most_sessions(config, on_ray=on_ray)
            for name, deployment in deployments.items():
                deployments[name] = with_full_passes(deployment, sessions, rows)
        local = None if on_ray else _local_policies(deployments, config.workers)
        if not on_ray and local is None:
            _require_simulators(config, address)
            _enter_ray(stack)

        agents: Agents = {}
        if local is None:
            plan = resolve(ready, workers=config.workers or 1)
        else:
            in_process, agents = _in_process(ready, local)
            plan = resolve(in_process, workers=0)

        # Raise errors before any process starts.
        if address is None:
            _require_resources(plan, deployments)
        _require_fit(plan, _by_policy(ready, deployments))
        _require_simulators(config, address)
        check_results(plan)

        if local is not None:
            if config.workers is None:
                out.print(
                    "a short evaluation, in this process without Ray (--workers 1 runs it in a "
                    "worker of Ray)"
                )
            stack.enter_context(variables(_variables(config, local)))
        swaps = None
        if local is None and deployments:
            swaps = stack.enter_context(
                _served_on_ray(plan, deployments, address, replica_per_gpu=replica_per_gpu)
            )
        yield Served(plan, agents, swaps)


def _most_sessions(config: EvalConfig, *, on_ray: bool) -> int:
    """Return the largest number of episodes that act at the same time; 1 if no worker steps several
    environments.
    """
    environments = max(case.suite.num_envs for case in plan_cases(config))
    workers = config.workers or 1 if on_ray else 1
    return environments * workers if environments > 1 else 1


def with_full_passes(deployment: Deployment, sessions: int, rows: int | None = None) -> Deployment:
    """Return the deployment of an evaluation, in which no bit of an action depends on its batch.

    Args:
        deployment: The deployment of a policy.
        sessions: The number of episodes that act at the same time. The passes have as many rows,
            rounded up to a power of two, at least `_LEAST_ROWS`, and at most `batch.max_size`. With
            1, the deployment is not changed, nor if its file sets `batch.invariant` or
            `batch.sizes`.
        rows: The number of rows of each pass of a recorded evaluation, which applies in any case.
    """
    changed = deployment.model_copy(deep=True)
    for app in our_apps(changed):
        batch = ServerArgs(**app.args).batch
        if rows is not None:
            app.args["batch"] = {
                "patience": batch.patience,
                "max_size": rows,
                "invariant": True,
            }
        elif sessions > 1 and not batch.model_fields_set & {"invariant", "sizes"}:
            size = min(batch.max_size, max(_LEAST_ROWS, 2 ** (sessions - 1).bit_length()))
            settings = app.args.get("batch") or {}
            app.args["batch"] = {**settings, "max_size": size, "invariant": "auto"}
    return changed


def planned_workers(
    config: EvalConfig, deployments: Mapping[str, Deployment], address: str | None = None
) -> int:
    """Return the number of workers with which `served` would run an evaluation.

    Args:
        config: The evaluation.
        deployments: The deployments of its policies, from `resolve_policies`.
        address: A running Ray cluster, as in `served`.

    Returns:
        The number of workers; 0 if the evaluation runs in this process.

    Raises:
        ConfigError: `workers` is 0, but the evaluation needs Ray.
    """
    _require_cluster_workers(config, address)
    workers = chosen_workers(config, plan_cases(config))
    if workers or address is not None or _local_policies(deployments, config.workers) is None:
        return workers or 1
    return 0


def _require_simulators(config: EvalConfig, address: str | None) -> None:
    """Raise `MissingDependency` if a simulator is not installed, unless it may run on another
    machine, or not at all, as a resumed evaluation may have all results.
    """
    if address is None and not may_use_cluster() and not config.resume:
        require_installed(plan_cases(config))


def _require_cluster_workers(config: EvalConfig, address: str | None) -> None:
    """Raise `ConfigError` if an evaluation in a cluster has no workers."""
    if config.workers == 0 and address is not None:
        raise ConfigError(
            "workers: expected 1 or more with --address, got 0; raise it, or leave out --address"
        )


def _require_resources(plan: ResolvedPlan, deployments: Mapping[str, Deployment]) -> None:
    """Raise `ConfigError` or `MissingDependency` unless this machine has the GPUs and packages."""
    needed = max(case.worker.gpus for case in plan.cases)
    available = gpus_here() if needed else 0.0
    if needed > available:  # Ray would never start these workers on this machine
        raise ConfigError(
            f"worker.gpus: expected at most the {available:g} GPUs of this machine, got "
            f"{needed:g} for a worker; set less (0 renders in software), or give the --address of "
            "a "
            "cluster that has them"
        )
    for deployment in deployments.values():
        require_packages(deployment)


def _by_policy(config: EvalConfig, deployments: Mapping[str, Deployment]) -> dict[str, Deployment]:
    """Return the deployments by the name of the policy in the evaluation, not by the name of the
    application.
    """
    by_policy = {}
    for policy in config.policies:
        application = str(policy.url).removeprefix("serve://")
        if application in deployments:
            by_policy[policy.name] = deployments[application]
    return by_policy


def _require_fit(plan: ResolvedPlan, deployments: Mapping[str, Deployment]) -> None:
    """Raise `ContractMismatch` unless the policies that will be served fit their simulations.

    Args:
        plan: The plan.
        deployments: The deployments of its policies, by their names in the plan.
    """
    policy_contract = cache(lambda policy: declared_contract(deployments[policy]))
    for case in plan.cases:
        if case.robot is not None or case.policy.name not in deployments:
            continue
        env_contract = known_contract(case.env, case.suite.env_options)
        if env_contract is not None:
            name = f"{case.policy.name!r} in {case.env!r}: "
            require_match(policy_contract(case.policy.name), env_contract, name)


def _local_policy(
    args: ServerArgs, config: Mapping[str, Any], *, checkpoint_step: int | None = None
) -> LocalPolicy:
    """Create a policy in this process, in a sweep over checkpoints with this training step."""
    step = {} if checkpoint_step is None else {CHECKPOINT_STEP: checkpoint_step}
    return LocalPolicy(args, {**config, **step})


def _variables(config: EvalConfig, local: Mapping[str, partial[LocalPolicy]]) -> dict[str, str]:
    """Return the environment variables that workers and replicas have, and with which this process
    computes the same results.
    """
    environment = dict.fromkeys(THREAD_VARIABLES, str(config.worker.threads))
    if not any(policy.args[0].resources.num_gpus for policy in local.values()):
        environment[VISIBLE] = ""  # hides the GPUs from this process
    return environment


def _in_process(
    config: EvalConfig, local: Mapping[str, partial[LocalPolicy]]
) -> tuple[EvalConfig, Agents]:
    """Return the evaluation without the URLs of the policies that run in this process, and the
    agents of these policies.
    """
    agents = {}
    policies = []
    for policy in config.policies:
        application = str(policy.url).removeprefix("serve://")
        if application in local:
            agents[policy.name] = local[application]
            policies.append(policy.model_copy(update={"url": None}))
        else:
            policies.append(policy)
    return config.model_copy(update={"policies": policies}), agents


@contextlib.contextmanager
def _served_on_ray(
    plan: ResolvedPlan,
    deployments: Mapping[str, Deployment],
    address: str | None,
    *,
    replica_per_gpu: bool,
) -> Iterator[CheckpointSwaps]:
    """Serve the policies on Ray within the context, and yield the swaps of their checkpoints."""
    from vlagents_ray.evaluate.plan.cases import most_cpus, most_gpus
    from vlagents_ray.serve.launch.checkpoint_swaps import ServedCheckpoints
    from vlagents_ray.serve.launch.server import running_server, spread_over_gpus

    workers = max(1, plan.workers)
    if replica_per_gpu:
        deployments = spread_over_gpus(deployments, reserved=workers * most_gpus(plan.cases))
    # The number of CPUs that Ray gets is logical: the requested number of workers must fit.
    cpus = max(os.cpu_count() or 1, math.ceil(workers * most_cpus(plan.cases)))
    applications = {
        policy.name: str(policy.url).removeprefix("serve://") for policy in plan.policies
    }
    deployed = together(deployments)
    for policy in plan.policies:
        if policy.steps:
            step = {CHECKPOINT_STEP: policy.steps[0]}
            deployed = with_user_config(deployed, applications[policy.name], step)
    with running_server(deployed, address=address, num_cpus=cpus, ingress=False) as server:
        yield ServedCheckpoints(server, applications)


def _enter_ray(stack: contextlib.ExitStack, address: str | None = None) -> None:
    """Within the context of `stack`, keep Ray's logs off the terminal, and join the cluster at
    `address`.
    """
    stack.enter_context(quiet_ray(None))
    stack.enter_context(exit_if_ray_is_lost(RESUME))
    if address is not None:
        stack.enter_context(joined(address))


def _local_policies(
    deployments: Mapping[str, Deployment], workers: int | None
) -> dict[str, partial[LocalPolicy]] | None:
    """Return the policies that run in this process, by application.

    Args:
        deployments: The deployments of the policies, by application.
        workers: The number of workers that the user has chosen, or None.

    Returns:
        The policies; None if any policy needs Ray.

    Raises:
        ConfigError: `workers` is 0, and a policy needs Ray.
    """
    local = {}
    for name, deployment in deployments.items():
        app = only_application(name, deployment)
        args: ServerArgs | None = None
        obstacle: str | None = "a runtime_env, or another import_path"
        if app.import_path == IMPORT_PATH and not app.runtime_env:
            args = ServerArgs(**app.args)
            obstacle = args.environment.python

        if workers == 0 and obstacle:
            raise ConfigError(
                f"workers: expected 1 or more, as {name!r} has {obstacle}, got 0, which runs the "
                f"episodes in this process; raise it"
            )
        if args is None or obstacle or (args.resources.num_gpus and workers is None):
            return None
        local[name] = partial(_local_policy, args, own_settings(app))
    return local


def resolve_policies(
    config: EvalConfig, *, ask: bool = True
) -> tuple[EvalConfig, dict[str, Deployment]]:
    """Find the names and URLs of an evaluation's policies.

    Args:
        config: The evaluation.
        ask: Whether to request the names, settings and checkpoints of policies from their servers.

    Returns:
        The evaluation with names and URLs, and the deployments to start, by application.

    Raises:
        ConfigError: A policy has neither a source nor a URL, or has settings although it is at a
            URL.
    """
    deployments: dict[str, Deployment] = {}
    policies = [_resolve_policy(policy, deployments, ask=ask) for policy in config.policies]
    fields = config.model_dump(exclude_unset=True) | {"policies": policies}
    return type(config).model_validate(fields), deployments


def _resolve_policy(
    policy: PolicyConfig, deployments: dict[str, Deployment], *, ask: bool
) -> PolicyConfig:
    """Return the policy with its name and URL; add its deployment to `deployments` unless a running
    server serves it.
    """
    url = policy.url
    if policy.source is not None and "://" in policy.source:
        url = policy.source
    if url is not None and policy.steps:
        raise ConfigError(
            f"policy {policy.name!r}: expected no `steps` with the running server {url}, which has "
            f"one checkpoint, got {policy.steps}; give its `source`, so that this command serves "
            "one checkpoint after another, or one policy with a `url` for each checkpoint"
        )
    if url is not None:
        return _policy_at(url, policy, ask=ask)
    if policy.source is None:
        raise ConfigError(
            f"policy {policy.name!r}: expected `source`, a policy to serve, or the `url` of a "
            "server, got neither; give one of them"
        )

    deployment = policy_deployment(policy, policy.source, step_follows=bool(policy.steps))
    settings = own_settings(deployment.applications[0])
    name = policy.name
    if "name" not in policy.model_fields_set:
        name = str(deployment.applications[0].args["policy"])
    application = re.sub(r"\W+", "-", name.rpartition(":")[2])

    # The results record the pattern of the checkpoints, not the step in this deployment.
    checkpoint = checkpoint_name(settings)
    if policy.steps:
        deployment = with_settings(deployment, {CHECKPOINT_STEP: policy.steps[0]})
        checkpoint = settings.get(CHECKPOINT)
    deployments[application] = deployment
    return policy.model_copy(
        update={
            "name": name,
            "url": f"serve://{application}",
            "config": settings,
            "checkpoint": checkpoint,
        }
    )


def _policy_at(url: str, policy: PolicyConfig, *, ask: bool) -> PolicyConfig:
    """Return the policy of a server.

    Args:
        url: The URL of the server.
        policy: The policy in the configuration.
        ask: Whether to take the name, the settings and the checkpoint from the server's metadata,
            since a result belongs to the served policy, not to an address.
    """
    fields: dict[str, Any] = {"url": url, "source": None}
    if not ask:
        return policy.model_copy(update=fields)

    if policy.config:
        names = sorted(policy.config)
        raise ConfigError(
            f"policy {policy.name!r}: expected no settings with a `url`, got {names}; set them in "
            f"the server at {url}"
        )
    # The server may still be starting.
    with RemoteAgent(url, connect_timeout_s=_STARTING_S) as agent:
        metadata = agent.metadata
    name, config = metadata.get("policy"), metadata.get("config", {})
    if not isinstance(name, str) or not isinstance(config, dict):
        raise MalformedMessage(
            f"{url}: metadata: expected the policy's name and its config, got {shown(name)} and "
            f"{shown(config)}"
        )
    has_name = "name" in policy.model_fields_set
    fields |= {
        "name": policy.name if has_name else name,
        "config": config,
        "checkpoint": metadata.get("checkpoint"),
    }
    return policy.model_copy(update=fields)


def policy_deployment(
    policy: PolicyConfig, source: str, *, step_follows: bool = False
) -> Deployment:
    """Read the deployment of a policy that an evaluation serves.

    Args:
        policy: The policy in the configuration; its settings are added to the deployment.
        source: A registered policy, "module:Class", or a deployment file.
        step_follows: Whether the step of the checkpoint is set later, as in `read_deployment`.
    """
    args = None
    if policy.config and not source.endswith(YAML_SUFFIXES):
        args = {"config": policy.config}
    deployment = read_deployment(source, args, step_follows=step_follows)
    return with_settings(deployment, policy.config, step_follows=step_follows)
