"""Other policy servers, in their own processes and Python environment.

A `<name>_peer.py` is a script, run by its path with the peers' Python: it imports the peer's packages, numpy, the
standard library and `peer.py` beside it, never `vlagents_ray`. `serve HOST PORT` is the peer's server with a policy
that does nothing; `drive HOST PORT OBS.npz MODE` is its own client, with the line protocol of `peer.py`. `evaluate HOST
PORT PLAN` is a whole evaluation, if the peer has one: only there the script imports the environment that all systems
play (`benchmarks/environments.py`).
"""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.drivers import START_S, ClientProcess, ProcessDriver
from benchmarks.round_trips import LOOPBACK, StartClient
from vlagents_ray.bench.line_process import LineProcess
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.launch.server import free_port

SCRIPTS = Path(__file__).parent
REQUIREMENTS = SCRIPTS / "requirements.txt"
FOLDER = Path(".venv-peers")
PYTHON = FOLDER / "bin" / "python"

# Options of the measurements.
Peers = Annotated[str, typer.Option(help="vlagents, openpi, openvla, vla-eval, with commas between them, or 'all'.")]
PeersPython = Annotated[
    Path, typer.Option(help="The Python of the peers' environment, which `python -m benchmarks.peers` makes.")
]


@dataclass(frozen=True, slots=True)
class PeerClient:
    """A peer's own client to its own server."""

    name: str
    peer: str  # its name for users, and the distribution that must be installed
    script: str
    mode: str
    distributions: tuple[str, ...]


PEER_CLIENTS = (
    PeerClient("vlagents shm", "vlagents", "vlagents_peer.py", "shm", ("vlagents", "rpyc", "simplejpeg")),
    PeerClient("vlagents JPEG", "vlagents", "vlagents_peer.py", "jpeg", ("vlagents", "rpyc", "simplejpeg")),
    PeerClient("openpi", "openpi", "openpi_peer.py", "raw", ("openpi-client", "websockets", "msgpack")),
    PeerClient("OpenVLA REST", "openvla", "openvla_peer.py", "raw", ("json-numpy", "fastapi", "uvicorn", "requests")),
    PeerClient("vla-eval", "vla-eval", "vla_eval_peer.py", "png", ("vla-eval", "websockets", "msgpack")),
)
PEERS = tuple(dict.fromkeys(one.peer for one in PEER_CLIENTS))


def peer_clients(names: Sequence[str], python: Path) -> tuple[list[PeerClient], dict[str, str], dict[str, str]]:
    """Return the clients of the peers in `names` (or "all"), the reasons for skipped ones, and installed versions."""
    wanted = PEERS if "all" in names else tuple(names)
    if unknown := set(wanted) - set(PEERS):
        raise ConfigError(f"peers: got {sorted(unknown)}, want some of {list(PEERS)}, or 'all'")
    if not wanted:
        return [], {}, {}
    cure = "`python -m benchmarks.peers` makes an environment for them"
    if not python.is_file():
        return [], dict.fromkeys(wanted, f"no Python at {python}; {cure}, --peers-python names another"), {}
    versions = installed(python, sorted({d for one in PEER_CLIENTS for d in one.distributions}))
    found, skipped = [], {}
    for one in PEER_CLIENTS:
        if one.peer in wanted:
            if missing := [name for name in one.distributions if name not in versions]:
                skipped[one.peer] = f"{', '.join(missing)} not installed for {python}; {cure}"
            else:
                found.append(one)
    return found, skipped, versions


def installed(python: Path, distributions: Sequence[str]) -> dict[str, str]:
    """Return the versions of the distributions that `python` has."""
    code = (
        "import importlib.metadata as m, json, sys\nfound = {}\nfor name in sys.argv[1:]:\n"
        "    try: found[name] = m.version(name)\n    except m.PackageNotFoundError: pass\nprint(json.dumps(found))"
    )
    command = [str(python), "-c", code, *distributions]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=True)
        versions: dict[str, str] = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise ConfigError(f"--peers-python {python}: cannot run it ({error}); name a Python") from error
    return versions


@contextlib.contextmanager
def peer_connected(
    client: PeerClient, python: Path, obs: Path, *, host: str = LOOPBACK, prefix: Sequence[str] = ()
) -> Iterator[ProcessDriver]:
    """Run a peer's server on `host`, and its client, whose command begins with `prefix`, within a context."""
    command, address = [str(python), str(SCRIPTS / client.script)], (host, str(free_port(host)))
    alone = {"PYTHONPATH": ""}  # nothing of ours in the peer's environment
    with (
        LineProcess(f"{client.name}, server", [*command, "serve", *address], alone) as server,
        ClientProcess(client.name, [*prefix, *command, "drive", *address, str(obs), client.mode], alone) as process,
    ):
        process.server_pid = server.pid
        yield process


def starters(
    clients: Sequence[PeerClient], python: Path, *, host: str = LOOPBACK, prefix: Sequence[str] = ()
) -> dict[str, StartClient]:
    """Return the starter of each client by its name, for `measure`."""
    return {one.name: partial(peer_connected, one, python, host=host, prefix=prefix) for one in clients}


def set_up(folder: Path, progress: Callable[[str], None] = lambda _: None) -> Path:
    """Make the environment, or update it to the pinned versions; returns its Python.

    It has no package of ours, since the peers' packages conflict with them. Raises `ConfigError` with the end of uv's
    output if that fails.
    """
    from vlagents_ray.serve.python_env.create import create, install

    python = create(folder, progress=progress)
    progress(f"installing {REQUIREMENTS.name}")
    install(python, ["--requirement", str(REQUIREMENTS)])
    return python
