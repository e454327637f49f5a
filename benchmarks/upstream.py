"""Measures the overhead of `upstream` over another policy server: one `act`, directly and through
our code, interleaved.

The server has openpi's protocol and answers immediately, so that only the transport takes time. It
is called in three ways: like openpi's own client, with the policy `upstream` as our batch queue
calls it, and through a whole server of ours.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import time
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import numpy as np
import typer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import serve

from benchmarks.console import Out, save, show_round_trips
from benchmarks.round_trips import RoundTripsOfAll, in_turns
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.interface import Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.serve.models.agent_copies import AgentCopies
from vlagents_ray.serve.ports import free_port
from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.upstream import Upstream

DIRECT, QUEUE, SERVER = "directly", "policy upstream", "server of ours"
_WARM_UP = 50
_UNBOUNDED: dict[str, Any] = {"compression": None, "max_size": None}
_ACTIONS = np.zeros((10, 7))
"""The actions of the server, (H, D)."""


def measure_upstream(
    calls: int, size: int, whole: bool, progress: Callable[[str], None] = lambda _: None
) -> RoundTripsOfAll:
    """Measure `calls` calls over each path.

    Args:
        calls: The number of calls over each path.
        size: Height and width of the two cameras' images, pixels.
        whole: Whether a whole server of ours, which starts Ray, is also measured.
        progress: Called with a line for each part of the measurement.
    """
    obs = _observation(size)
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(_serving())
        queue = _Queue(url, obs, stack)  # called first, as it waits until the server answers
        drivers: dict[str, _Driver] = {DIRECT: stack.enter_context(_Direct(url, obs)), QUEUE: queue}
        if whole:
            drivers[SERVER] = _Server(url, obs, stack)
        for driver in drivers.values():
            driver.measure(_WARM_UP)
        return RoundTripsOfAll(tuple(in_turns(drivers, calls, progress).values()))


class _Driver:
    """Makes calls over one path."""

    call: Callable[[], Any]

    def ready(self) -> dict[str, Any]:
        """Return nothing: the path is ready."""
        return {}

    def measure(self, calls: int) -> list[float]:
        """Make calls, and return their durations, ms."""
        taken = []
        for _ in range(calls):
            begun = time.perf_counter()
            self.call()
            taken.append((time.perf_counter() - begun) * 1e3)
        return taken


class _Direct(_Driver, contextlib.ExitStack):
    """Packs, sends, receives and unpacks like openpi_client.websocket_client_policy."""

    def __init__(self, url: str, obs: Obs) -> None:
        super().__init__()
        connection = self.enter_context(connect(url, **_UNBOUNDED))
        connection.recv()
        state = np.concatenate([obs.state["xyz_axis_angle"], obs.state["gripper_qpos"]])
        theirs = {
            "observation/image": obs.cameras["front"],
            "observation/wrist_image": obs.cameras["wrist"],
            "observation/state": state,
            "prompt": "a task",
        }

        def call() -> Any:
            connection.send(openpi.encode(theirs))
            return openpi.decode(connection.recv(decode=False))

        self.call = call


class _Queue(_Driver):
    """Calls the policy `upstream` as an engine does."""

    def __init__(self, url: str, obs: Obs, stack: contextlib.ExitStack) -> None:
        agent = stack.enter_context(Upstream.from_config(_settings(url)))
        agent.initialize()
        session = AgentCopies(agent).make()
        session.reset(obs, "a task")

        def call() -> Any:
            [act] = agent.act_batch([obs], [session])
            if isinstance(act, Exception):
                raise act
            return act

        self.call = call


class _Server(_Driver):
    """A server of ours in front of the other server, and a client in this process."""

    def __init__(self, url: str, obs: Obs, stack: contextlib.ExitStack) -> None:
        server = stack.enter_context(
            running_server(deployment("upstream", config=_settings(url)), num_cpus=2)
        )
        agent = stack.enter_context(RemoteAgent(server.url))
        agent.reset(obs, "a task")
        self.call = lambda: agent.act(obs)


def _settings(url: str) -> dict[str, Any]:
    return {"protocol": "openpi", "urls": [url], "mapping": "openpi-libero"}


def _observation(size: int) -> Obs:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (2, size, size, 3), np.uint8)
    state = {"xyz_axis_angle": np.zeros(6, np.float32), "gripper_qpos": np.zeros(2, np.float32)}
    return Obs({"front": pixels[0], "wrist": pixels[1]}, 0.5, state)


@contextlib.contextmanager
def _serving() -> Iterator[str]:
    """Run the other server in a new process."""
    port = free_port()
    process = multiprocessing.get_context("spawn").Process(target=_serve, args=(port,), daemon=True)
    process.start()
    try:
        yield f"ws://127.0.0.1:{port}"
    finally:
        process.kill()
        process.join()


def _serve(port: int) -> None:
    def answer(connection: Any) -> None:
        connection.send(openpi.encode({}))
        with contextlib.suppress(ConnectionClosed):
            for message in connection:
                openpi.decode(message)
                connection.send(openpi.encode({"actions": _ACTIONS}))

    with serve(answer, "127.0.0.1", port, **_UNBOUNDED) as server:
        server.serve_forever()


def main(
    calls: Annotated[int, typer.Option(min=1, help="Number of calls over each path.")] = 2000,
    size: Annotated[
        int, typer.Option(min=1, help="Height and width of the two images, pixels.")
    ] = 224,
    whole: Annotated[
        bool, typer.Option(help="Also measure a whole server of ours, which starts Ray.")
    ] = False,
    out_file: Out = None,
) -> None:
    """Measure the overhead of the policy `upstream` over the policy server behind it."""
    with errors():
        found = measure_upstream(calls, size, whole, progress).to_json()
    show_round_trips(found, f"one act, two images of {size} x {size} pixels")
    save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
