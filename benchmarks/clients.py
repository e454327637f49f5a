"""Measures round trips of the clients in other languages and of the Python client, interleaved at
one server.

Each client is a process, and all send the same raw pixels. Build the client in TypeScript first:
`cd clients/typescript && npm ci && npm run build`. The C++ client is compiled here, with the
packages in its README.md.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.console import Out, save, show_round_trips
from benchmarks.drivers import ClientProcess, Driver
from benchmarks.own_clients import OwnClient, connected, observation
from benchmarks.round_trips import POLICY, RoundTripsOfAll, in_turns
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

HERE, CLIENTS = Path(__file__).parent, Path(__file__).parents[1] / "clients"
TYPESCRIPT = CLIENTS / "typescript"
PYTHON = (OwnClient("websocket", "raw"), OwnClient("http", "raw"))
CPP = "C++, websocket"
NODE = {"Node.js, websocket": "websocket", "Node.js, http": "http"}


def measure_clients(
    url: str, calls: int, progress: Callable[[str], None] = lambda _: None
) -> RoundTripsOfAll:
    """Measure `calls` round trips of each client at the server of `url`.

    Raises:
        ConfigError: Node.js or the compiler is missing, or the client in TypeScript was not built.
    """
    node = shutil.which("node")
    if node is None or not (TYPESCRIPT / "dist" / "index.js").exists():
        raise ConfigError(
            f"clients: expected Node.js 18, and `npm ci && npm run build` in {TYPESCRIPT}"
        )
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        _save(observation(), folder)
        drivers: dict[str, Driver] = {
            f"Python, {one.transport}": stack.enter_context(connected(one, url, ""))
            for one in PYTHON
        }
        drivers[CPP] = stack.enter_context(
            ClientProcess(CPP, [_compiled(folder), url, str(folder)])
        )
        script = str(HERE / "node_client.mjs")
        for name, transport in NODE.items():
            command = [
                node,
                script,
                str(TYPESCRIPT / "dist" / "index.js"),
                url,
                transport,
                str(folder),
            ]
            drivers[name] = stack.enter_context(ClientProcess(name, command))
        for driver in drivers.values():
            driver.ready()
        return RoundTripsOfAll(tuple(in_turns(drivers, calls, progress).values()))


def _compiled(folder: Path) -> str:
    """Compile the C++ client as for a release, and return its path."""
    program = str(folder / "cpp_client")
    command = [
        "c++",
        "-std=c++17",
        "-O2",
        f"-I{CLIENTS / 'cpp' / 'include'}",
        str(HERE / "cpp_client.cpp"),
    ]
    try:
        subprocess.run(
            [*command, "-o", program, "-ljpeg", "-pthread"],
            check=True,
            capture_output=True,
            text=True,
        )
    except (FileNotFoundError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", error)
        raise ConfigError(
            f"clients: expected what {CLIENTS / 'cpp' / 'README.md'} installs; the compiler: {said}"
        ) from error
    return program


def _save(obs: Obs, folder: Path) -> None:
    """Write the observation for clients in any language: the pixels of each camera, and all other
    values as JSON.
    """
    cameras = {}
    for name, image in obs.cameras.items():
        (folder / name).write_bytes(image.tobytes())
        cameras[name] = image.shape[:2]
    state = {name: part.tolist() for name, part in obs.state.items()}
    (folder / "obs.json").write_text(
        json.dumps({"cameras": cameras, "gripper": obs.gripper, "state": state})
    )


def main(
    calls: Annotated[int, typer.Option(min=1, help="Number of calls of each client.")] = 2000,
    out_file: Out = None,
) -> None:
    """Measure round trips of the clients in other languages and of the Python client."""
    with errors():
        with running_server(deployment(POLICY), host="127.0.0.1") as server:
            [url] = server.apps.values()
            found = measure_clients(url, calls, progress).to_json()
        show_round_trips(found, "one act, raw pixels, on one machine")
        save(found, out_file)


if __name__ == "__main__":
    typer.run(main)
