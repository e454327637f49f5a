"""The Serve application builder that deployment files name: `import_path: vlagents_ray.serve.app:build`.

Without `from __future__ import annotations`: Ray reads the builder's annotation as a class.
"""

import os
import warnings
from typing import Any

from ray import serve
from ray.serve import Application

from vlagents_ray.serve.config import GATEWAY, POLICY, ServerArgs
from vlagents_ray.serve.deployment import PolicyReplica
from vlagents_ray.serve.environments.interpreter import placed
from vlagents_ray.serve.gateways.deployment import Gateway

_HEAD = "node:__internal_head__"  # a resource that Ray gives to the head node of any cluster
# A replica does not know them, nor restarts when they change.
_OUTSIDE: Any = {"replicas": True, "autoscaling": True, "resources": True, "dialects": {"gr00t", "vlagents"}}


def build(args: ServerArgs) -> Application:
    """One policy as a Serve application. Ray passes the file's `args`, checked against `ServerArgs`."""
    args = args.model_copy(update={"environment": placed(args.environment)})
    options: dict[str, Any] = {
        "name": POLICY,
        # A WebSocket session counts as a request as long as it lasts, so this must hold all sessions
        # besides two batches; it protects nothing, since the batch queue orders what waits.
        "max_ongoing_requests": args.sessions.limit + 2 * args.batch.max_size,
        "graceful_shutdown_timeout_s": 20,
        "health_check_period_s": 1 if args.environment.process == "child" else 5,  # Serve wants three failures
        "user_config": {},  # of `config`, what a file states beside `args`: it changes without a restart
        "ray_actor_options": {
            "num_cpus": args.resources.num_cpus,
            "num_gpus": args.resources.num_gpus,
            "resources": args.resources.custom,
            **({} if args.resources.memory is None else {"memory": args.resources.memory}),
            "runtime_env": args.environment.runtime_env(),
        },
    }
    if args.autoscaling is not None:
        options["autoscaling_config"] = args.autoscaling.options()
    else:
        options["num_replicas"] = args.replicas or 1
    if os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") != "1":
        # HAProxy hashes the session header by itself (see cluster.py) and refuses a custom router.
        from ray.serve.config import RequestRouterConfig

        options["request_router_config"] = RequestRouterConfig(
            request_router_class="ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"
        )
    replica = serve.ingress()(PolicyReplica)
    with warnings.catch_warnings():  # `metrics_interval_s`, whose successor is one variable for a whole cluster
        warnings.simplefilter("ignore", DeprecationWarning)
        policy = serve.deployment(**options)(replica)
    settings = args.model_dump(mode="json", exclude=_OUTSIDE)
    return policy.bind(settings, _gateway(args)) if args.dialects.gateways() else policy.bind(settings)


def _gateway(args: ServerArgs) -> Application:
    """The process with the doors that have a port of their own, where clients will look for them: on the head node."""
    options: dict[str, Any] = {
        "name": GATEWAY,
        "num_replicas": 1,
        "graceful_shutdown_timeout_s": 10,
        "graceful_shutdown_wait_loop_s": 0.1,  # no request waits here: its clients are behind its doors
        "health_check_period_s": 5,
        "ray_actor_options": {"num_cpus": 0, "resources": {_HEAD: 0.001}},
    }
    settings = args.model_dump(mode="json", include={"policy", "dialects", "limits", "sessions", "access"})
    return serve.deployment(**options)(Gateway).bind(settings)
