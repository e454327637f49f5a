"""Plain Ray Serve, without this project: a deployment with `@serve.batch`, as in Ray's
documentation.

In mode "http" a client posts msgpack with raw bytes over a connection that stays open; in mode
"handle" the client is another driver of the same cluster, with the deployment's handle.
`max_ongoing_requests` is raised, as otherwise no batch would have more than five rows;
`batch_wait_timeout_s` is Ray's default, 10 ms.
"""

from __future__ import annotations

import os
import threading
import time
from typing import Any

import msgpack
import numpy as np
import peer

# This is Ray's default if it starts a cluster, but not if it joins one.
os.environ.setdefault("RAY_AUTH_MODE", "token")
# The same setting as in a server of ours. By default Ray's workers have a low priority, and start
# slowly on a busy machine, where Serve ends a proxy that has not started within 5 s.
os.environ.setdefault("RAY_worker_niceness", "0")
os.environ.setdefault("RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S", "60")

import ray
import requests
from ray import serve as ray_serve
from starlette.requests import Request
from starlette.responses import Response

_START_S = 400.0
_ATTEMPTS = 3


@ray_serve.deployment(max_ongoing_requests=128)
class Model:
    """The policy in a replica."""

    def __init__(self, policy: peer.Policy) -> None:
        self._policy = policy
        self.infer.set_max_batch_size(policy.batch)

    @ray_serve.batch
    async def infer(self, observations: list[dict[str, np.ndarray]]) -> list[np.ndarray]:
        return list(self._policy(len(observations)))

    async def act(self, obs: dict[str, np.ndarray]) -> np.ndarray:
        """Answer a call of the handle."""
        return await self.infer(obs)

    async def __call__(self, request: Request) -> Response:
        """Answer `POST /` with an action, `GET /` with the address of the cluster."""
        if request.method == "GET":
            return Response(ray.get_runtime_context().gcs_address)
        packed = msgpack.unpackb(await request.body())
        obs = {
            name: np.frombuffer(data, dtype).reshape(shape)
            for name, (data, dtype, shape) in packed.items()
        }
        return Response((await self.infer(obs)).tobytes())


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server until the process ends."""
    _start_ray()
    _start_proxy(host, port)
    ray_serve.run(Model.bind(policy))
    threading.Event().wait()


def _start_ray() -> None:
    """Start a Ray cluster for this process; try again twice, as the start has fixed time limits."""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            ray.init(
                address="local", num_cpus=4, include_dashboard=False, object_store_memory=2**28
            )
        except Exception:  # Ray raises a plain Exception
            if attempt == _ATTEMPTS:
                raise
            ray.shutdown()
        else:
            return


def _start_proxy(host: str, port: int) -> None:
    """Start Serve's controller and its proxy, which may take minutes on a busy machine.

    Serve's call fails after one minute, or when the proxy has been replaced; controller and proxy
    continue nevertheless, and the next call finds the controller.
    """
    deadline = time.monotonic() + _START_S
    while True:
        try:
            ray_serve.start(http_options={"host": host, "port": port})
        except (TimeoutError, ray.exceptions.RayActorError):
            if time.monotonic() > deadline:
                raise
        else:
            return


def connect(target: peer.Target) -> peer.Client:
    """Return a client of the mode, once the replica answers."""
    url = f"http://{target.host}:{target.port}/"
    deadline = time.monotonic() + _START_S
    while True:
        try:
            answer = requests.get(url, timeout=_START_S)
            answer.raise_for_status()
            break
        except requests.RequestException:
            # the proxy resets connections until it knows the replica
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    obs = target.cameras | {"state": target.state}
    if target.mode == "handle":
        ray.init(address=answer.text, ignore_reinit_error=True)
        handle = ray_serve.get_app_handle("default")
        return peer.Client(lambda: obs, lambda obs: handle.act.remote(obs).result())
    session = requests.Session()

    def act(obs: dict[str, np.ndarray]) -> np.ndarray:
        packed: dict[str, Any] = {
            name: (array.tobytes(), str(array.dtype), array.shape) for name, array in obs.items()
        }
        answer = session.post(url, msgpack.packb(packed))
        answer.raise_for_status()
        return np.frombuffer(answer.content, np.float32)

    return peer.Client(lambda: obs, act, session.close)


if __name__ == "__main__":
    peer.run(serve, connect, end=ray.shutdown)
