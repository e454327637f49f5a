"""One Ray instance with Serve for the whole test process, on which test files deploy their policies
one after the other.

A file that needs Ray, but no separate instance, uses the fixture `shared_ray`. Ray starts for the
first such file, and stops before the first test of a file without the fixture, which may start a
separate instance. The order of files in conftest.py makes this happen only once. Only tests of
launching, of crashes and of Ray's settings start a separate instance. So do tests of commands that
start Ray, since these would inherit the environment of the shared instance.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.serve.ports import LOOPBACK, free_port, keep

FIXTURE = "shared_ray"
_CPUS = 4  # only a number for Ray's accounting, for replicas and workers of evaluations
# Time limit for a policy to be ready, including packages that Ray installs; CI may have a fraction
# of two cores.
_READY_S = 400.0
_EXAMPLES = Path(__file__).parents[2] / "examples"
# Folders of policies that tests serve: the tests' own policies, and examples with several files.
_POLICIES = (Path(__file__).parent, _EXAMPLES / "raptor", _EXAMPLES / "two_models")

_running: contextlib.ExitStack | None = None
_port = 0  # Serve's HTTP port


def start() -> None:
    """Start Ray unless it is running."""
    global _running, _port  # noqa: PLW0603 - one for each process
    if _running is not None:
        return
    from vlagents_ray.serve.launch.server import own_ray

    _port = free_port()
    with contextlib.ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        # 2 s instead of 10 s, since tests wait for metrics.
        patch.setenv("RAY_metrics_report_interval_ms", "2000")
        # 0.3 s instead of 0.1 s, since with 0.1 s Serve's controller uses half a CPU while this Ray
        # runs.
        patch.setenv("RAY_SERVE_CONTROL_LOOP_INTERVAL_S", "0.3")
        patch.setenv("PYTHONPATH", os.pathsep.join(map(str, _POLICIES)), prepend=os.pathsep)
        stack.enter_context(own_ray(LOOPBACK, _port, num_cpus=_CPUS))
        _running = stack.pop_all()


def stop() -> None:
    """Stop Ray and Serve if they are running."""
    global _running
    if _running is None:
        return
    from ray.serve.context import _get_global_client

    from vlagents_ray.serve.launch.server import shut_down

    running, _running = _running, None
    with running:
        if (client := _get_global_client(raise_if_no_controller_running=False)) is not None:
            shut_down(client)


@contextlib.contextmanager
def shared_server(config: Any) -> Iterator[Any]:
    """Serve a deployment on the shared Ray during the context, like `running_server` does on a
    separate Ray.

    Args:
        config: A `Deployment`.

    Yields:
        A `Server`.

    Raises:
        ConfigError: An application failed to deploy.
    """
    from ray import serve

    from vlagents_ray.ray_tools.private import proxies_now, start_serve
    from vlagents_ray.serve.config.deployment import ServerArgs
    from vlagents_ray.serve.launch.deployment_file import with_gateways_at
    from vlagents_ray.serve.launch.haproxy import wait_for_haproxy
    from vlagents_ray.serve.launch.server import Server, deploy, wait_for_proxies, wait_until_ready

    assert _running is not None, f"the test file must use the fixture {FIXTURE}"
    config = with_gateways_at(config, LOOPBACK)
    for app in config.applications:
        keep(*(one.port for one in ServerArgs(**app.args).dialects.gateways().values()))
    client, proxies = start_serve({"host": LOOPBACK, "port": _port}, "HeadOnly")
    url = f"http://{LOOPBACK}:{_port}"
    paths = {app.name: (app.route_prefix or "").rstrip("/") for app in config.applications}
    urls = {name: url + path for name, path in paths.items()}
    deadline = time.monotonic() + _READY_S
    try:
        deploy(client, config, is_own_ray=True, ingress=True)
        wait_for_proxies(proxies, lambda: proxies_now(client))
        wait_until_ready(serve, urls, set(paths), deadline)
        if (stats_port := os.environ.get("RAY_SERVE_HAPROXY_STATS_PORT")) is not None:
            wait_for_haproxy(serve, paths, int(stats_port), deadline)
        yield Server(url, config, urls)
    finally:
        client.delete_apps(list(serve.status().applications))
