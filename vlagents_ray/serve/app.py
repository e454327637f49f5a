"""The Serve application builder that deployment files name: `import_path: vlagents_ray.serve.app:build`.

Without `from __future__ import annotations`: Ray reads the builder's annotation as a class.
"""

import os
import warnings
from typing import Any

from ray import serve
from ray.serve import Application

from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.deployment import PolicyReplica

DEPLOYMENT = "Policy"
_OUTSIDE = {"replicas", "autoscaling", "resources"}  # a replica does not know them, nor restarts when they change


def build(args: ServerArgs) -> Application:
    """One policy as a Serve application. Ray passes the file's `args`, checked against `ServerArgs`."""
    options: dict[str, Any] = {
        "name": DEPLOYMENT,
        # A WebSocket session counts as a request as long as it lasts, so this must hold all sessions
        # besides two batches; it protects nothing, since the batch queue orders what waits.
        "max_ongoing_requests": args.sessions.limit + 2 * args.batch.max_size,
        "graceful_shutdown_timeout_s": 20,
        "health_check_period_s": 5,
        "ray_actor_options": {
            "num_cpus": args.resources.num_cpus,
            "num_gpus": args.resources.num_gpus,
            "resources": args.resources.custom,
            **({} if args.resources.memory is None else {"memory": args.resources.memory}),
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
        return serve.deployment(**options)(replica).bind(args.model_dump(mode="json", exclude=_OUTSIDE))
