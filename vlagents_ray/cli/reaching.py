"""Where the policies of an evaluation are: at their URLs, or served for its length."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.joining import joined
from vlagents_ray.serve.checkpoints import STEP, resolved
from vlagents_ray.serve.cluster import running_server, spread_over_gpus
from vlagents_ray.serve.files import own_settings, read_deployment, together, with_settings

if TYPE_CHECKING:
    from ray.serve.schema import ServeDeploySchema

    from vlagents_ray.evaluate import EvalConfig, PolicyConfig

FILE = (".yaml", ".yml")


@contextlib.contextmanager
def served(config: EvalConfig, address: str | None = None, *, replica_per_gpu: bool = False) -> Iterator[EvalConfig]:
    """`config` with the URLs of its policies, those that are not at one being served for the length of the context.

    `replica_per_gpu` goes with the `address` of a cluster, whose GPUs they share.
    """
    from vlagents_ray.evaluate import check, most_cpus, most_gpus

    with contextlib.ExitStack() as stack:
        if address is not None:
            stack.enter_context(joined(address))
        config, parts = reached(config)
        check(config)  # what is wrong is said before anything starts
        if parts and replica_per_gpu:
            parts = spread_over_gpus(parts, kept=config.workers * most_gpus(config))
        if parts:
            # Ray's CPUs are bookkeeping here: the number of workers that the user asked for must fit.
            cpus = max(os.cpu_count() or 1, math.ceil(config.workers * most_cpus(config)))
            stack.enter_context(running_server(together(parts), address=address, num_cpus=cpus))
        yield config


def reached(config: EvalConfig, *, ask: bool = True) -> tuple[EvalConfig, dict[str, ServeDeploySchema]]:
    """`config` with what its policies are and where; and by application those that are to be served there.

    A server at a URL is asked what it serves, unless `ask` is off.
    """
    parts: dict[str, ServeDeploySchema] = {}
    policies = [_reached(policy, parts, ask=ask) for policy in config.policies]
    return type(config).model_validate(config.model_dump(exclude_unset=True) | {"policies": policies}), parts


def _reached(policy: PolicyConfig, parts: dict[str, ServeDeploySchema], *, ask: bool) -> PolicyConfig:
    """`policy` with its URL and with what it is; one that is to be served joins `parts`."""
    url = policy.source if policy.source is not None and "://" in policy.source else policy.url
    if url is not None:
        return policy.model_copy(update={"url": url, "source": None} | (_found(policy, url) if ask else {}))
    if policy.source is None:
        raise ConfigError(f"policy {policy.name!r}: want `source`, a policy to serve, or the `url` of a server")
    part = deployed(policy, policy.source)
    own = own_settings(part.applications[0])
    name = policy.name if "name" in policy.model_fields_set else str(part.applications[0].args["policy"])
    application = re.sub(r"\W+", "-", name.rpartition(":")[2])
    if policy.steps and own.get(STEP) is None:  # the deployment's own is some step; what is recorded is the pattern
        part = with_settings(part, {STEP: policy.steps[0]}, steps=True)
    parts[application] = part
    found = {"name": name, "url": f"serve://{application}", "config": own, "checkpoint": resolved(own)}
    return policy.model_copy(update=found)


def deployed(policy: PolicyConfig, source: str) -> ServeDeploySchema:
    """The deployment of `source` with the settings of `policy`."""
    of_name = {"config": policy.config} if policy.config and not source.endswith(FILE) else None
    return with_settings(read_deployment(source, of_name), policy.config, steps=bool(policy.steps))


def _found(policy: PolicyConfig, url: str) -> dict[str, Any]:
    """What the server says that it serves: a result belongs to that, not to an address."""
    from vlagents_ray import RemoteAgent

    if policy.config:
        raise ConfigError(f"policy {policy.name!r}: got {sorted(policy.config)}, but {url} has its settings already")
    with RemoteAgent(url) as agent:
        said = agent.metadata
    name = policy.name if "name" in policy.model_fields_set else said["policy"]
    return {"name": name, "config": said.get("config", {}), "checkpoint": said.get("checkpoint")}
