"""Compares HTTP with JPEG with its lower bound: a bare application that decodes the images and
answers 200.

One run measures, interleaved: our HTTP and WebSocket clients, vlagents' JPEG client, and the bare
application, once directly and once behind an HAProxy with the settings of a server. The bare
application only decodes the frame, and its client only encodes a frame and posts it with
`http.client`. A round trip to it is therefore the minimum time of a request with these images over
HTTP.

`python -m benchmarks.http_floor` measures; with `serve` and `drive` it runs the bare application
and its client.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import typer

from benchmarks import peers as others
from benchmarks.console import Calls, Out, TableOfPage, save, show_round_trips, show_use
from benchmarks.drivers import START_S, ClientProcess, ProcessDriver
from benchmarks.figures import measured_on
from benchmarks.further_tables import replace_rows
from benchmarks.line_client import obey, timed
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.own_clients import OwnClient, observation
from benchmarks.round_trips import LOOPBACK, StartClient, measure
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.errors import ConfigError
from vlagents_ray.images.codecs import JPEG
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_requests, encode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, Request
from vlagents_ray.serve.launch.haproxy import haproxy_binary, ingress_environment
from vlagents_ray.serve.ports import free_port
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

BARE = DIRECT, PROXIED = "bare HTTP application", "bare HTTP application behind HAProxy"
OWN = (OwnClient("http", "jpeg"), OwnClient("websocket", "jpeg"))
_COMMAND = (sys.executable, "-m", "benchmarks.http_floor")


async def _app(scope: dict[str, Any], receive: Any, send: Any) -> None:
    """Answer 200 to each request, once its frame is decoded."""
    if scope["type"] != "http":
        return
    body = b""
    while True:
        message = await receive()
        body += message.get("body", b"")
        if not message.get("more_body", False):
            break
    if body:
        decode_requests(body, Budget(DEFAULT_LIMITS))
    await send(
        {"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]}
    )
    await send({"type": "http.response.body", "body": b"ok"})


def _serve(is_proxied: bool) -> None:
    """Serve the bare application until the standard input ends; print its port as JSON."""
    import uvicorn

    die_with_parent()
    out = own_stdout()
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind((LOOPBACK, 0))
        port = listener.getsockname()[1]
        config = uvicorn.Config(_app, log_level="warning", access_log=False)
        server = uvicorn.Server(config)
        threading.Thread(target=server.run, args=([listener],), daemon=True).start()
        if is_proxied:
            port = stack.enter_context(_haproxy(port))
        print(json.dumps({"port": port}), file=out, flush=True)
        sys.stdin.read()


@contextlib.contextmanager
def _haproxy(port: int) -> Iterator[int]:
    """Run HAProxy in front of a port, with the settings that Serve writes; yield HAProxy's port."""
    binary = haproxy_binary()
    if binary is None:
        raise ConfigError("expected HAProxy, which is not installed; see docs/install.md")
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        # Serve reads these variables when it is imported.
        os.environ.update(ingress_environment(Path(name), str(binary)))
        from ray.serve._private.haproxy import (
            BackendConfig,
            HAProxyApi,
            HAProxyConfig,
            ServerConfig,
            get_haproxy_binary,
        )
        from ray.serve.config import HTTPOptions

        proxied = free_port(LOOPBACK)
        replicas = [ServerConfig("SERVE_REPLICA_app-Bare-1", LOOPBACK, port)]
        backend = BackendConfig("http-app", "/", servers=replicas, app_name="app")
        config = HAProxyConfig(
            http_options=HTTPOptions(host=LOOPBACK, port=proxied),
            has_received_routes=True,
            has_received_servers=True,
        )
        api = HAProxyApi(config, {"app": backend})
        api._generate_config_file_internal()
        command = [get_haproxy_binary(), "-db", "-f", api.config_file_path, "-dR"]
        with subprocess.Popen(command) as proxy:
            try:
                _wait_for(proxied)
                yield proxied
            finally:
                proxy.terminate()


def _wait_for(port: int) -> None:
    """Wait until a server answers 200 at that port."""
    end = time.monotonic() + START_S
    while True:
        with contextlib.closing(http.client.HTTPConnection(LOOPBACK, port, timeout=5)) as client:
            try:
                client.request("POST", "/v1/act")
                if client.getresponse().status == 200:
                    return
            except OSError:
                pass
        if time.monotonic() > end:
            raise TimeoutError(f"no server answers at port {port} within {START_S:g} s")
        time.sleep(0.1)


def _drive(port: int) -> None:
    """Run the client of the bare application."""
    die_with_parent()
    out = own_stdout()
    obs = observation()
    _wait_for(port)

    def measure_turn(calls: int) -> list[float]:
        """Make calls over a new connection, since HAProxy closes a connection that is idle between
        turns.
        """
        connection = http.client.HTTPConnection(LOOPBACK, port)
        connection.connect()
        connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

        def call(_: object) -> None:
            """Post one frame."""
            frame = encode_requests([Request("act", obs, request_id="a")], JPEG)
            connection.request("POST", "/v1/act", frame, {"content-type": CONTENT_TYPE})
            answer = connection.getresponse()
            answer.read()
            if answer.status != 200:
                raise ConfigError(f"expected 200 of the bare application, got {answer.status}")

        with contextlib.closing(connection):
            return timed(lambda: None, call, calls)

    obey(sys.stdin, out, measure_turn, {})


@contextlib.contextmanager
def bare_application(_obs: Path, *, is_proxied: bool) -> Iterator[ProcessDriver]:
    """Run the bare application and its client."""
    name = PROXIED if is_proxied else DIRECT
    serve = [*_COMMAND, "serve", *(["proxied"] if is_proxied else [])]
    with LineProcess(f"{name}, server", serve, our_environment()) as server:
        port = server.read(START_S)["port"]
        with ClientProcess(name, [*_COMMAND, "drive", str(port)], our_environment()) as client:
            client.server_pid = server.pid
            yield client


def measure_floor(calls: int, peers_python: Path) -> dict[str, Any]:
    """Measure the round trips and the CPU time of calls over HTTP, and of the bare application.

    Args:
        calls: Number of round trips of each client.
        peers_python: The Python in which vlagents is installed.

    Returns:
        The result of `benchmarks.round_trips.measure(...).to_json()`.
    """
    found, absent, versions = others.peer_clients(["vlagents"], peers_python)
    jpeg = [one for one in found if one.mode == "jpeg"]
    starters: dict[str, StartClient] = others.starters(jpeg, peers_python)
    starters[DIRECT] = partial(bare_application, is_proxied=False)
    if haproxy_binary() is not None:
        starters[PROXIED] = partial(bare_application, is_proxied=True)
    trips = measure(OWN, calls, progress, others=starters, skipped=absent)
    return trips.to_json() | {"versions": versions}


def page_table(found: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return the table of docs/measured_tables.md: its headings, and a row for each way.

    Args:
        found: The result of `measure_floor`.
    """
    head = [
        "",
        "median ms",
        "/ bare HTTP",
        "/ bare HTTP behind HAProxy",
        "client CPU ms",
        "server CPU ms",
    ]
    rows = []
    for way in (*found["peers"], *found["ways"]):
        name = way["way"]
        ratios = found["ratios"].get(name, {})
        cells = [f"{ratios[bare]['ratio']:.2f}" if bare in ratios else "" for bare in BARE]
        use = [f"{found['use'][name][side]['cpu_ms']:.2f}" for side in ("client", "server")]
        rows.append([name, f"{way['median_ms']:.2f}", *cells, *use])
    return head, rows


def main(
    calls: Calls = 1000,
    peers_python: others.PeersPython = others.PYTHON,
    table_of_page: TableOfPage = False,
    out_file: Out = None,
) -> None:
    """Compare HTTP with JPEG with a bare application, the WebSocket, and vlagents."""
    with errors():
        origin = measured_on("python -m benchmarks.http_floor")
        found = measure_floor(calls, peers_python)
        show_round_trips(found, "round trip of one act over HTTP on this machine")
        show_use(found)
        if table_of_page:
            head, rows = page_table(found)
            replace_rows("HTTP and its lower bound", head, rows, origin["date"])
        save({**origin, **found, "versions": origin["versions"] | found["versions"]}, out_file)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        _serve("proxied" in sys.argv)
    elif sys.argv[1:2] == ["drive"]:
        _drive(int(sys.argv[2]))
    else:
        typer.run(main)
