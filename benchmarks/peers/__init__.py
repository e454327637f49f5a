"""Other policy servers, in their own processes and Python environments.

A `<name>_peer.py` is a script, run by its path with a peer's Python: it imports the peer's
packages, numpy, the standard library and `peer.py` in the same folder, never `vlagents_ray`.
`serve` is the peer's server with a policy that does nothing, or sleeps; `drive` and `load` are the
peer's own clients, with the line protocol of `peer.py`. `evaluate` is a whole evaluation, if the
peer has evaluations: only then the script imports the environment that all systems run
(`benchmarks/environments.py`).
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
from benchmarks.line_process import LineProcess
from benchmarks.processes import descendants
from benchmarks.round_trips import StartClient
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import requirements_file
from vlagents_ray.serve.ports import LOOPBACK, free_port

SCRIPTS = Path(__file__).parent
REQUIREMENTS = SCRIPTS / "requirements.txt"
# The suffix of the name of a second environment.
TORCH, TORCH_REQUIREMENTS = "-torch", SCRIPTS / "requirements-torch.txt"
# Version of torch that LeRobot gets without a GPU.
CPU = requirements_file("lerobot").with_suffix(".cpu.txt")
FOLDER = Path(".venv-peers")
PYTHON = FOLDER / "bin" / "python"

# Options of the measurements
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
    peer: str  # the peer's name for users
    script: str
    mode: str
    distributions: tuple[str, ...]  # distributions that must be installed
    environment: str = ""  # suffix of the environment's name: "" or `TORCH`
    several: bool = True  # whether the peer's server can have several clients at the same time
    server: bool = True  # whether the peer's server is a separate process
    one_process: bool = False  # whether all the peer's clients must be in one process
    # Whether the idle server uses whole cores, so that it is stopped between turns.
    polls: bool = False
    shares: bool = False  # whether the clients of the peer's script share a server

    def python(self, python: Path) -> Path:
        """Return the Python of the peer's environment, given the Python of the first
        environment.
        """
        folder = python.absolute().parents[1]
        return (
            folder.with_name(folder.name + self.environment) / "bin" / python.name
            if self.environment
            else python
        )

    def command(self, python: Path) -> list[str]:
        """Return the command that runs the peer's script."""
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
Policy = Mapping[str, float]  # arguments of the peer's `peer.Policy`
_NO_STATISTICS = "RAY_USAGE_STATS_ENABLED"
# Without compiled files, an import of Ray Serve takes three times the CPU time. Serve ends a proxy
# that starts late, and the next one is as late, so the server never starts on a slow machine.
_NO_COMPILED_FILES = "PYTHONDONTWRITEBYTECODE"
# Time limit of a start, s, as some peers import torch, or start Ray, in several processes at once.
READY_S = 450.0


def alone() -> dict[str, str | None]:
    """Return the changes of a peer's environment variables, which remove ours, such as those of a
    running server's HAProxy, and the one that prevents compiled files.
    """
    ours = [
        name
        for name in os.environ
        if name.startswith(("RAY_", "VLAGENTS_RAY_")) and name != _NO_STATISTICS
    ]
    return {"PYTHONPATH": "", **dict.fromkeys((*ours, _NO_COMPILED_FILES))}


def peer_clients(
    names: Sequence[str], python: Path
) -> tuple[list[PeerClient], dict[str, str], dict[str, str]]:
    """Return the clients of the peers in `names` (or "all"), the reasons for skipped peers, and the
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
    """Return the versions of the distributions that are installed for `python`."""
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
    # The server's process; None if the clients' process starts the server.
    process: LineProcess | None
    polls: bool

    @contextlib.contextmanager
    def turn(self) -> Iterator[None]:
        """Let a polling server run within a context, and stop it afterwards."""
        self.signal(signal.SIGCONT)
        try:
            yield
        finally:
            self.signal(signal.SIGSTOP)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the processes of a server that polls.

        The signal is not sent to the helper process of `multiprocessing`, which waits for the end
        of a pipe: if the helper were stopped, it would outlive a killed benchmark.
        """
        if not self.polls or self.process is None:
            return
        for pid in (self.process.pid, *descendants(self.process.pid)):
            with contextlib.suppress(OSError):  # the process has ended
                if b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes():
                    os.kill(pid, number)


class _PeerDriver(ClientProcess):
    """A client whose server only runs during the client's turns."""

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
) -> Iterator[PeerServer]:
    """Run a peer's server within a context; if `running` has a server that the peer shares, yield
    that server instead.
    """
    if client.script in running:
        yield running[client.script]
        return
    address = (LOOPBACK, str(free_port()))
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
) -> Iterator[ProcessDriver]:
    """Run a peer's server and the peer's client within a context."""
    with serving(client, python, running, {}) as server:
        command = [
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


def starters(clients: Sequence[PeerClient], python: Path) -> dict[str, StartClient]:
    """Return the starter of each client by its name, for `measure`. The contexts must be exited in
    reverse order.
    """
    running: dict[str, PeerServer] = {}
    return {one.name: partial(peer_connected, one, python, running=running) for one in clients}


def set_up(
    folder: Path,
    requirements: Path = REQUIREMENTS,
    progress: Callable[[str], None] = lambda _: None,
) -> Path:
    """Create an environment, or update it to the pinned versions, and return its Python.

    The environment has no package of ours, since the peers' packages conflict with ours, and its
    torch is for CPUs. Raises `ConfigError` with the end of uv's output if that fails.
    """
    from vlagents_ray.serve.python_env.create import create, install, require_no_cuda

    python = create(folder, progress=progress)
    progress(f"installing {requirements.name}")
    wanted = ["--requirement", str(requirements), "--override", str(CPU)]
    require_no_cuda(python, wanted)
    install(python, wanted)
    return python
