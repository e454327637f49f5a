"""The ways from an observation to an action that are compared: every transport of ours, and the peers."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, get_args

import vlagents_ray
from vlagents_ray.bench.child import Child
from vlagents_ray.client.ways import TransportName
from vlagents_ray.errors import ConfigError

SCRIPTS = Path(__file__).parent / "peers"
REQUIREMENTS = SCRIPTS / "requirements.txt"
START_S = 90.0
_CALL_S = 30.0


@dataclass(frozen=True, slots=True)
class Way:
    """A transport of ours. `codec` is as in `vlagents_ray.bench.client.connect`."""

    transport: str
    codec: str = "raw"
    actor: bool = False  # from inside a Ray actor, by serve://

    @property
    def name(self) -> str:
        """For the table."""
        if self.transport in ("shm", "handle", "plasma"):
            return f"{self.transport}, Ray actor" if self.actor else self.transport
        return f"{self.transport}, {'default' if self.codec == 'auto' else self.codec}"


WAYS = (
    Way("plasma", actor=True),
    Way("handle", actor=True),
    Way("shm", actor=True),
    Way("shm"),
    Way("websocket", "raw"),
    Way("websocket", "jpeg"),
    Way("websocket", "auto"),
    Way("http", "raw"),
    Way("http", "jpeg"),
)


def ways(only: Sequence[str] = ()) -> tuple[list[Way], dict[str, str]]:
    """Those that this version has (or those of them whose transport is in `only`), and why not the others."""
    known = get_args(TransportName)
    wanted = [way for way in WAYS if not only or way.transport in only]
    if unknown := set(only) - {way.transport for way in WAYS}:
        raise ConfigError(f"transports: got {sorted(unknown)}, want some of {sorted({w.transport for w in WAYS})}")
    skipped = {w.name: f"no transport {w.transport!r} in this version" for w in wanted if w.transport not in known}
    return [way for way in wanted if way.transport in known], skipped


@dataclass(frozen=True, slots=True)
class PeerWay:
    """A peer's own client to its own server."""

    name: str
    peer: str  # as users name it, and the distribution that must be installed
    script: str
    mode: str
    distributions: tuple[str, ...]


PEER_WAYS = (
    PeerWay("vlagents shm", "vlagents", "vlagents_peer.py", "shm", ("vlagents", "rpyc", "simplejpeg")),
    PeerWay("vlagents JPEG", "vlagents", "vlagents_peer.py", "jpeg", ("vlagents", "rpyc", "simplejpeg")),
    PeerWay("openpi", "openpi", "openpi_peer.py", "raw", ("openpi-client", "websockets", "msgpack")),
    PeerWay("OpenVLA REST", "openvla", "openvla_peer.py", "raw", ("json-numpy", "fastapi", "uvicorn", "requests")),
    PeerWay("vla-eval", "vla-eval", "vla_eval_peer.py", "png", ("vla-eval", "websockets", "msgpack")),
)
PEERS = tuple(dict.fromkeys(way.peer for way in PEER_WAYS))


def peer_ways(names: Sequence[str], python: Path) -> tuple[list[PeerWay], dict[str, str], dict[str, str]]:
    """The ways of the peers called `names` ("all" is all), why others are skipped, and installed versions."""
    wanted = PEERS if "all" in names else tuple(names)
    if unknown := set(wanted) - set(PEERS):
        raise ConfigError(f"peers: got {sorted(unknown)}, want some of {list(PEERS)}, or 'all'")
    if not wanted:
        return [], {}, {}
    cure = "`vlagents-ray bench peers-setup` makes an environment for them"
    if not python.is_file():
        return [], dict.fromkeys(wanted, f"no Python at {python}; {cure}, --peers-python names another"), {}
    versions = installed(python, sorted({d for way in PEER_WAYS for d in way.distributions}))
    found, skipped = [], {}
    for way in PEER_WAYS:
        if way.peer in wanted:
            if missing := [name for name in way.distributions if name not in versions]:
                skipped[way.peer] = f"{', '.join(missing)} not installed for {python}; {cure}"
            else:
                found.append(way)
    return found, skipped, versions


def installed(python: Path, distributions: Sequence[str]) -> dict[str, str]:
    """Versions of those distributions that this Python has."""
    code = (
        "import importlib.metadata as m, json, sys\nfound = {}\nfor name in sys.argv[1:]:\n"
        "    try: found[name] = m.version(name)\n    except m.PackageNotFoundError: pass\nprint(json.dumps(found))"
    )
    command = [str(python), "-c", code, *distributions]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=START_S, check=True)  # noqa: S603
        versions: dict[str, str] = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError) as error:
        raise ConfigError(f"--peers-python {python}: cannot run it ({error}); name a Python") from error
    return versions


class Driver(Protocol):
    """A way that is connected: makes calls when it is its turn."""

    def ready(self) -> dict[str, Any]:
        """Wait until it is connected and warm; what it says of itself."""
        ...

    def measure(self, calls: int) -> list[float]:
        """Milliseconds of each call."""
        ...


@dataclass(frozen=True, slots=True)
class ProcessDriver:
    """A client in a process of its own."""

    child: Child

    def ready(self) -> dict[str, Any]:
        """Its first line."""
        said: dict[str, Any] = self.child.hear(START_S)
        return said

    def measure(self, calls: int) -> list[float]:
        """A line there, a line back."""
        taken: list[float] = self.child.ask(str(calls), _CALL_S + calls)
        return taken


@dataclass(frozen=True, slots=True)
class ActorDriver:
    """A client in a Ray actor, as rollouts are."""

    actor: Any

    def ready(self) -> dict[str, Any]:
        """Once it has connected."""
        import ray

        said: dict[str, Any] = ray.get(self.actor.ready.remote(), timeout=START_S)
        return said

    def measure(self, calls: int) -> list[float]:
        """One actor call."""
        import ray

        taken: list[float] = ray.get(self.actor.measure.remote(calls), timeout=_CALL_S + calls)
        return taken


@contextlib.contextmanager
def connected(way: Way, url: str, app: str, prefix: Sequence[str] = ()) -> Iterator[Driver]:
    """A client of ours to the server at `url`; its command begins with `prefix`."""
    if way.actor:
        import ray

        from vlagents_ray.bench.client import Caller

        actor = ray.remote(num_cpus=0)(Caller).remote(f"serve://{app}", way.transport, way.codec)
        try:
            yield ActorDriver(actor)
        finally:
            with contextlib.suppress(ray.exceptions.RayError):  # one that never connected has told why already
                ray.get(actor.close.remote(), timeout=_CALL_S)
            ray.kill(actor)
        return
    settings = json.dumps({"url": url, "transport": way.transport, "codec": way.codec})
    command = [*prefix, sys.executable, "-m", "vlagents_ray.bench.client", settings]
    with Child(way.name, command, our_environment()) as child:
        yield ProcessDriver(child)


@contextlib.contextmanager
def peer_connected(
    way: PeerWay, python: Path, host: str, port: int, obs: Path, prefix: Sequence[str] = ()
) -> Iterator[Driver]:
    """A peer's server on `host`, and its client, whose command begins with `prefix`. Both end with the context."""
    script = str(SCRIPTS / way.script)
    address = (host, str(port))
    alone = {"PYTHONPATH": ""}  # nothing of ours in the peer's environment
    with (
        Child(f"{way.name}, server", [str(python), script, "serve", *address], alone),
        Child(way.name, [*prefix, str(python), script, "drive", *address, str(obs), way.mode], alone) as child,
    ):
        yield ProcessDriver(child)


def our_environment() -> dict[str, str]:
    """So that a process of ours finds this package, installed or not."""
    package = str(Path(vlagents_ray.__file__).parent.parent)
    others = [one for one in os.environ.get("PYTHONPATH", "").split(os.pathsep) if one and one != package]
    return {"PYTHONPATH": os.pathsep.join([package, *others])}
