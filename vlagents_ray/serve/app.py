"""Builds the Serve application of one policy: its deployments, and Serve's options for them.

Deployment files refer to it with `import_path: vlagents_ray.serve.app:build`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError
from ray import serve
from ray.serve import Application
from ray.serve.config import RequestRouterConfig
from ray.serve.exceptions import RayServeException

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.ray_tools.private import check_ray
from vlagents_ray.ray_tools.session import HEAD_NODE
from vlagents_ray.serve.config.deployment import GATEWAY, POLICY, ServerArgs
from vlagents_ray.serve.dialects.gateway import Gateway
from vlagents_ray.serve.python_env.probe import with_process
from vlagents_ray.serve.replica.replica import PolicyReplica
from vlagents_ray.settings import wrong_settings

_FAILURES = 3  # number of consecutive failed health checks after which Serve replaces a replica
_LEAST_ANSWER_S = 5.0  # minimum time limit of a health check, for a busy machine
# Settings that are not passed to a replica, so that it is not restarted when they change. The
# dialects of the gateway are not passed either.
_OUTSIDE: Any = {"replicas": True, "autoscaling": True, "resources": True}
# Period at which Serve counts the remaining requests of a stopping replica; the default is 2 s.
_AT_ONCE: Any = {"graceful_shutdown_wait_loop_s": 0.1}


def build(args: Mapping[str, Any] | ServerArgs) -> Application:
    """Build the Serve application of one policy from the `args` of a deployment file.

    Raises:
        RayServeException: A setting is wrong, or the policy's environment is missing. For this
            exception, `serve status` shows only the text; for any other, it shows a traceback of
            forty lines.
    """
    try:
        check_ray()
        return application(ServerArgs.model_validate(args))
    except ValidationError as error:
        raise RayServeException(wrong_settings(error, ServerArgs)) from None
    except VLAgentsError as error:
        raise RayServeException(f"{type(error).__name__}: {error}") from None


def application(args: ServerArgs, *, drains: bool = True) -> Application:
    """Build the Serve application of one policy.

    Args:
        drains: Whether stopping replicas wait for requests over HTTP.

    Raises:
        ConfigError: The policy cannot run in its environment.
    """
    args = args.model_copy(update={"environment": with_process(args.environment)})

    actor_options: dict[str, Any] = {
        "num_cpus": args.resources.num_cpus,
        "num_gpus": args.resources.num_gpus,
        "resources": args.resources.custom,
    }
    if args.resources.memory is not None:
        actor_options["memory"] = args.resources.memory
    runtime_env = args.environment.runtime_env()
    if runtime_env:  # otherwise Serve applies the application's `runtime_env`
        actor_options["runtime_env"] = runtime_env

    options: dict[str, Any] = {
        "name": POLICY,
        # A replica is replaced after three failed checks.
        "health_check_period_s": 1 if args.environment.process == "child" else 5,
        # A replica that does not reply is frozen, or its policy holds the interpreter's lock. Then
        # only these checks limit the time of a call. The failed checks take as long together as the
        # time limit of a call; with Serve's defaults they would take 95 s for every policy.
        "health_check_timeout_s": max(_LEAST_ANSWER_S, args.limits.act_s / _FAILURES),
        # A replica may be killed while it loads, so Serve starts a second one. While other replicas
        # run, Serve ignores this limit and retries forever.
        "max_constructor_retry_count": 2,
        # Settings of the policy that a deployment file may contain next to `args`; they can change
        # without a restart.
        "user_config": {},
        "ray_actor_options": actor_options,
        # A WebSocket session counts as one request until it ends, so the limit must allow all
        # sessions and two batches. The limit does not protect against overload, since requests wait
        # in the batch queue.
        "max_ongoing_requests": args.sessions.limit + 2 * args.batch.max_size,
        "graceful_shutdown_timeout_s": 20,
    }
    if not drains:
        options.update(_AT_ONCE)
    if args.autoscaling is not None:
        options["autoscaling_config"] = args.autoscaling.options()
    else:
        options["num_replicas"] = args.replicas or 1
    if os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") != "1":
        # HAProxy itself hashes the session header (see haproxy.py) and rejects a custom router.
        options["request_router_config"] = RequestRouterConfig(
            request_router_class="vlagents_ray.serve.scaling.router.SessionRouter"
        )

    replica = serve.ingress()(PolicyReplica)
    # Serve has deprecated `metrics_interval_s` in favour of an environment variable, which affects
    # the whole cluster.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        policy = serve.deployment(**options)(replica)

    gateways = args.dialects.gateways()
    settings = args.model_dump(mode="json", exclude=_OUTSIDE | {"dialects": set(gateways)})
    return policy.bind(settings, _gateway(args) if gateways else None)


def _gateway(args: ServerArgs) -> Application:
    """Build the deployment of the gateway, the process of the dialects that have their own port. It
    runs on the head node, where clients connect.
    """
    options: dict[str, Any] = {
        "name": GATEWAY,
        "num_replicas": 1,
        "graceful_shutdown_timeout_s": 10,
        **_AT_ONCE,  # the gateway's clients use its own ports, not Serve's
        "health_check_period_s": 5,
        "ray_actor_options": {"num_cpus": 0, "resources": {HEAD_NODE: 0.001}},
    }
    settings = args.model_dump(
        mode="json", include={"policy", "dialects", "limits", "sessions", "access"}
    )
    return serve.deployment(**options)(Gateway).bind(settings)
