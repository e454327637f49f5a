"""Other policy servers, in their own processes and Python environments.

A `<name>_peer.py` is a script, run by its path with a peer's Python: it imports the peer's
packages, numpy, the standard library and `peer.py` beside it, never `vlagents_ray`. `serve` is the
peer's server with a policy that does nothing, or sleeps; `drive` and `load` are its own clients,
with the line protocol of `peer.py`. `evaluate` is a whole evaluation, if the peer has one: only
there the script imports the environment that all systems play (`benchmarks/environments.py`).
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.drivers import START_S, ClientProcess, ProcessDriver
from benchmarks.processes import descendants
from benchmarks.round_trips import LOOPBACK, StartClient
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import requirements_file
from vlagents_ray.serve.ports import free_port
from vlagents_ray_cluster.tune.line_process import LineProcess

SCRIPTS = Path(__file__).parent
REQUIREMENTS = SCRIPTS / "requirements.txt"
# The end of a second environment's name.
TORCH, TORCH_REQUIREMENTS = "-torch", SCRIPTS / "requirements-torch.txt"
CPU = requirements_file("lerobot").with_suffix(".cpu.txt")  # what LeRobot gets without a GPU
FOLDER = Path(".venv-peers")
PYTHON = FOLDER / "bin" / "python"

# Options of the measurements.
Peers = Annotated[
    str,
    typer.Option(
        help="vlagents, openpi, openvla, vla-eval, gr00t, portal, torchrl, ray-serve, lerobot, "
        "with commas between "
        "them, or 'all'."
    ),
]
PeersPython = Annotated[
    Path,
    typer.Option(
        help="The Python of the peers' environment, which `python -m benchmarks.peers` makes; "
        "those that need torch "
        f"are in a second one beside it, whose name ends in {TORCH}."
    ),
]


@dataclass(frozen=True, slots=True)
class PeerClient:
    """A peer's own client to its own server."""

    name: str
    peer: str  # its name for users
    script: str
    mode: str
    distributions: tuple[str, ...]  # that must be installed
    environment: str = ""  # or `TORCH`
    several: bool = True  # whether its server has several clients at once
    server: bool = True  # whether its server is a separate process
    one_process: bool = False  # whether all its clients must be in one process
    # Whether its idle server takes whole cores, so that it is stopped between turns.
    polls: bool = False
    shares: bool = False  # whether the clients of its script share a server

    def python(self, python: Path) -> Path:
        """Return the Python of its environment, where `python` is that of the first."""
        folder = python.absolute().parents[1]
        return (
            folder.with_name(folder.name + self.environment) / "bin" / python.name
            if self.environment
            else python
        )

    def command(self, python: Path) -> list[str]:
        """Return the command that runs its script."""
        return [str(self.python(python)), str(SCRIPTS / self.script)]


_VLAGENTS = ("vlagents", "rpyc", "simplejpeg")
_RAY_SERVE = ("ray", "msgpack", "requests")
PEER_CLIENTS = (
    PeerClient("vlagents shm", "vlagents", "vlagents_peer.py", "shm", _VLAGENTS),
    PeerClient("vlagents JPEG", "vlagents", "vlagents_peer.py", "jpeg", _VLAGENTS),
    PeerClient(
        "openpi", "openpi", "openpi_peer.py", "raw", ("openpi-client", "websockets", "msgpack")
    ),
    PeerClient(
        "OpenVLA REST",
        "openvla",
        "openvla_peer.py",
        "raw",
        ("json-numpy", "fastapi", "uvicorn", "requests"),
    ),
    PeerClient(
        "vla-eval", "vla-eval", "vla_eval_peer.py", "png", ("vla-eval", "websockets", "msgpack")
    ),
    PeerClient("GR00T ZMQ (own code)", "gr00t", "gr00t_peer.py", "npy", ("pyzmq", "msgpack")),
    PeerClient(
        "portal", "portal", "portal_peer.py", "raw", ("portal",), one_process=True, polls=True
    ),
    PeerClient(
        "TorchRL",
        "torchrl",
        "torchrl_peer.py",
        "slots",
        ("torchrl", "tensordict", "torch"),
        TORCH,
        server=False,
        one_process=True,
    ),
    PeerClient(
        "Ray Serve HTTP", "ray-serve", "ray_serve_peer.py", "http", _RAY_SERVE, TORCH, shares=True
    ),
    PeerClient(
        "Ray Serve handle",
        "ray-serve",
        "ray_serve_peer.py",
        "handle",
        _RAY_SERVE,
        TORCH,
        shares=True,
    ),
    PeerClient(
        "LeRobot",
        "lerobot",
        "lerobot_peer.py",
        "pickle",
        ("lerobot", "grpcio", "torch"),
        TORCH,
        several=False,
    ),
)
PEERS = tuple(dict.fromkeys(one.peer for one in PEER_CLIENTS))
Policy = Mapping[str, float]  # arguments of `peer.Policy`
_NO_STATISTICS = "RAY_USAGE_STATS_ENABLED"
READY_S = 450.0  # some import torch, or start Ray, several processes at once


def alone() -> dict[str, str | None]:
    """Return the changes of a peer's environment variables: none of ours, as those of a running
    server's HAProxy.
    """
    ours = [
        name
        for name in os.environ
        if name.startswith(("RAY_", "VLAGENTS_RAY_")) and name != _NO_STATISTICS
    ]
    return {"PYTHONPATH": "", **dict.fromkeys(ours)}


def peer_clients(
    names: Sequence[str], python: Path
) -> tuple[list[PeerClient], dict[str, str], dict[str, str]]:
    """Return the clients of the peers in `names` (or "all"), the reasons for skipped ones, and
    installed versions.
    """
    wanted = PEERS if "all" in names else tuple(names)
    if unknown := set(wanted) - set(PEERS):
        raise ConfigError(f"peers: expected only {list(PEERS)}, or 'all', got {sorted(unknown)}")
    found: list[PeerClient] = []
    skipped: dict[str, str] = {}
    versions: dict[str, str] = {}
    cure = "`python -m benchmarks.peers` makes an environment for them"
    there: dict[Path, dict[str, str]] = {}
    for one in PEER_CLIENTS:
        if one.peer not in wanted:
            continue
        theirs = one.python(python)
        if not theirs.is_file():
            skipped[one.peer] = f"no Python at {theirs}; {cure}, --peers-python names another"
            continue
        if theirs not in there:
            there[theirs] = installed(
                theirs, sorted({d for each in PEER_CLIENTS for d in each.distributions})
            )
        if missing := [name for name in one.distributions if name not in there[theirs]]:
            skipped[one.peer] = f"{', '.join(missing)} not installed for {theirs}; {cure}"
        else:
            found.append(one)
            versions |= {name: there[theirs][name] for name in one.distributions}
    return found, skipped, versions


def installed(python: Path, distributions: Sequence[str]) -> dict[str, str]:
    """Return the versions of the distributions that `python` has."""
    code = (
        "import importlib.metadata as m, json, sys\nfound = {}\nfor name in sys.argv[1:]:\n"
        "    try: found[name] = m.version(name)\n    except m.PackageNotFoundError: "
        "pass\nprint(json.dumps(found))"
    )
    command = [str(python), "-c", code, *distributions]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=True)
        versions: dict[str, str] = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise ConfigError(
            f"--peers-python {python}: cannot run it ({error}); name a Python"
        ) from error
    return versions


@dataclass(frozen=True, slots=True)
class PeerServer:
    """A peer's server."""

    address: tuple[str, str]  # host and port
    process: LineProcess | None  # None: the clients' process starts it
    polls: bool

    @contextlib.contextmanager
    def turn(self) -> Iterator[None]:
        """Let a server that polls run within a context, and stop it after."""
        self.signal(signal.SIGCONT)
        try:
            yield
        finally:
            self.signal(signal.SIGSTOP)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the processes of a server that polls.

        It is not sent to the helper of `multiprocessing`, which waits for the end of a pipe:
        stopped, it would never see that end, and outlive a killed benchmark.
        """
        if not self.polls or self.process is None:
            return
        for pid in (self.process.pid, *descendants(self.process.pid)):
            with contextlib.suppress(OSError):  # it has ended
                if b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, number)


class _PeerDriver(ClientProcess):
    """A client whose server runs in its turns."""

    def __init__(self, server: PeerServer, name: str, command: Sequence[str]) -> None:
        super().__init__(name, command, alone())
        self._server = server

    def ready(self) -> dict[str, Any]:
        with self._server.turn():
            said: dict[str, Any] = self.read(READY_S, self._server.process)
            return said

    def measure(self, calls: int) -> list[float]:
        with self._server.turn():
            return super().measure(calls)


@contextlib.contextmanager
def serving(
    client: PeerClient,
    python: Path,
    running: dict[str, PeerServer],
    policy: Policy,
    *,
    host: str = LOOPBACK,
) -> Iterator[PeerServer]:
    """Run a peer's server within a context, unless `running` has one that it shares: then yield
    that.
    """
    if client.script in running:
        yield running[client.script]
        return
    address = (host, str(free_port(host)))
    with contextlib.ExitStack() as stack:
        process = None
        if client.server:
            command = [*client.command(python), "serve", *address, json.dumps(dict(policy))]
            process = stack.enter_context(LineProcess(f"{client.name}, server", command, alone()))
        server = PeerServer(address, process, client.polls)
        if client.shares:
            running[client.script] = server
        try:
            yield server
        finally:
            server.signal(signal.SIGCONT)
            running.pop(client.script, None)


@contextlib.contextmanager
def peer_connected(
    client: PeerClient,
    python: Path,
    obs: Path,
    running: dict[str, PeerServer],
    *,
    host: str = LOOPBACK,
    prefix: Sequence[str] = (),
) -> Iterator[ProcessDriver]:
    """Run a peer's server on `host`, and its client, whose command begins with `prefix`, within
    a context.
    """
    with serving(client, python, running, {}, host=host) as server:
        command = [
            *prefix,
            *client.command(python),
            "drive",
            *server.address,
            str(obs),
            client.mode,
            "{}",
        ]
        with _PeerDriver(server, client.name, command) as process:
            process.server_pid = process.pid if server.process is None else server.process.pid
            yield process


def starters(
    clients: Sequence[PeerClient], python: Path, *, host: str = LOOPBACK, prefix: Sequence[str] = ()
) -> dict[str, StartClient]:
    """Return the starter of each client by its name, for `measure`. They are entered and left as
    a stack is.
    """
    running: dict[str, PeerServer] = {}
    return {
        one.name: partial(peer_connected, one, python, running=running, host=host, prefix=prefix)
        for one in clients
    }


def set_up(
    folder: Path,
    requirements: Path = REQUIREMENTS,
    progress: Callable[[str], None] = lambda _: None,
) -> Path:
    """Make an environment, or update it to the pinned versions; returns its Python.

    It has no package of ours, since the peers' packages conflict with them, and a torch for CPUs.
    Raises `ConfigError` with the end of uv's output if that fails.
    """
    from vlagents_ray.serve.python_env.create import create, install, require_no_cuda

    python = create(folder, progress=progress)
    progress(f"installing {requirements.name}")
    wanted = ["--requirement", str(requirements), "--override", str(CPU)]
    require_no_cuda(python, wanted)
    install(python, wanted)
    return python
