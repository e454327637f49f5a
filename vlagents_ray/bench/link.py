"""Round trips over a true network link, on one machine: two network namespaces, a shaped veth pair between them.

The servers live in one namespace, the clients in the other. A namespace ends with its last process, and each
process here ends with its parent or its standard input: nothing is left, however the benchmark ends. Without
root it runs in a user namespace, where the kernel allows that.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.bench.child import Child
from vlagents_ray.bench.peers.peer import die_with_parent, own_stdout
from vlagents_ray.bench.rtt import measure
from vlagents_ray.bench.ways import Way, our_environment, peer_ways
from vlagents_ray.errors import ConfigError, VLAgentsError

RATE = "1gbit"
PEERS = ("vlagents", "openpi")
WAYS = (Way("websocket", "raw"), Way("websocket", "jpeg"), Way("websocket", "auto"), Way("http", "jpeg"))
SHM = "vlagents shm"  # does not cross a network
_SERVER, _CLIENT = "10.197.44.1", "10.197.44.2"
_BULK = 64 * 2**20  # bytes, to see what the link carries
_END_S = 60.0
_RUN_S = 900.0
_TOOLS = ("ip", "tc", "unshare", "nsenter")


def measure_link(
    calls: int = 600,
    *,
    rate: str = RATE,
    delay: str | None = None,
    peers: Sequence[str] = (),
    peers_python: Path = Path("python"),
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """What `measure_rtt(...).to_json()` gives, and what the link is. `rate` and `delay` are as `tc` takes them.

    Raises `ConfigError` with the cure where this machine or user cannot make network namespaces.
    """
    command = [*enter(), sys.executable, "-m", "vlagents_ray.bench.link"]
    settings = {
        "calls": calls,
        "rate": rate,
        "delay": delay,
        "peers": list(peers),
        "peers_python": str(peers_python.absolute()),  # not resolved: a virtual environment's Python is a link
    }
    with Child("the link", [*command, json.dumps(settings)], our_environment(), end_s=_END_S) as inside:
        while True:
            said = inside.hear(_RUN_S)
            if "tell" in said:
                tell(said["tell"])
            elif "error" in said:
                raise ConfigError(said["error"])
            else:
                found: dict[str, Any] = said["result"]
                return found


def enter() -> list[str]:
    """The command that runs another one in a network namespace of its own, as root or as somebody who looks like it."""
    if missing := [tool for tool in _TOOLS if shutil.which(tool) is None]:
        raise ConfigError(f"link: {', '.join(missing)} not found; install iproute2 and util-linux")
    refusals = []
    for command in (["unshare", "--net"], ["unshare", "--user", "--map-root-user", "--net"]):
        done = subprocess.run([*command, "true"], capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode == 0:
            return command
        refusals.append(done.stderr.strip())
    raise ConfigError(refused(refusals))


def refused(reasons: Sequence[str]) -> str:
    """What a user without the right is told."""
    return (
        f"link: cannot make a network namespace, neither as this user nor in a user namespace ({'; '.join(reasons)}); "
        "run it as root, or let users make them: sysctl kernel.unprivileged_userns_clone=1 (Debian), "
        "kernel.apparmor_restrict_unprivileged_userns=0 (Ubuntu)"
    )


class Link:
    """The client's namespace, and the shaped link to it. Made inside the server's namespace."""

    def __init__(self, rate: str, delay: str | None) -> None:
        self._holder = Child("the client's namespace", ["unshare", "--net", "cat"])
        try:
            self._holder.ask("1", 10)  # an answer: it is there
            target = f"/proc/{self._holder.pid}/ns/net"
            self.prefix = ["nsenter", f"--net={target}"]
            _run(["ip", "link", "set", "lo", "up"])
            _run(["ip", "link", "add", "vlagents0", "type", "veth", "peer", "name", "vlagents1"])
            _run(["ip", "link", "set", "vlagents1", "netns", str(self._holder.pid)])
            for prefix, name, address in (([], "vlagents0", _SERVER), (self.prefix, "vlagents1", _CLIENT)):
                _run([*prefix, "ip", "address", "add", f"{address}/24", "dev", name])
                _run([*prefix, "ip", "link", "set", name, "up"])
                for words in shaping(rate, delay):
                    _run([*prefix, "tc", "qdisc", "add", "dev", name, *words])
            # Ray takes the address that leads to the world for its own; without a way there it would take one that
            # this namespace does not have.
            _run(["ip", "route", "add", "default", "via", _CLIENT])
        except BaseException:
            self._holder.close()
            raise

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *exc: object) -> None:
        self._holder.close()

    def megabits(self) -> float:
        """Mbit/s that TCP gets through, from client to server."""
        code = f"import socket; s = socket.create_connection(({_SERVER!r}, {{}})); s.sendall(bytes({_BULK}))"
        with socket.create_server((_SERVER, 0)) as server:
            server.settimeout(30)
            command = [*self.prefix, sys.executable, "-c", code.format(server.getsockname()[1])]
            with subprocess.Popen(command) as sender:  # noqa: S603 - this very Python
                connection, _ = server.accept()
                with connection:
                    begun, got = time.perf_counter(), 0
                    while data := connection.recv(2**20):
                        got += len(data)
                    taken = time.perf_counter() - begun
                sender.wait(30)
        return got * 8 / taken / 1e6


def shaping(rate: str, delay: str | None) -> list[list[str]]:
    """The `tc qdisc add dev DEV …` for a link of that rate, and that delay each way."""
    if delay is None:
        return [["root", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"]]
    return [
        ["root", "handle", "1:", "netem", "delay", delay, "limit", "10000"],
        ["parent", "1:1", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"],
    ]


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(list(command), capture_output=True, text=True, check=False)  # noqa: S603 - ip and tc
    if done.returncode == 0:
        return
    reason = done.stderr.strip()
    if "netem" in command and "unknown" in reason:
        raise ConfigError(f"--delay: this kernel has no netem ({reason}); leave it out, or load the module sch_netem")
    raise ConfigError(f"link: `{' '.join(command)}` failed: {reason}")


def _inside(calls: int, rate: str, delay: str | None, peers: Sequence[str], peers_python: str, tell: Any) -> Any:
    """The benchmark, in the server's namespace."""
    others, absent, versions = peer_ways(peers, Path(peers_python))
    others = [way for way in others if way.name != SHM]
    with Link(rate, delay) as link:
        carried = link.megabits()
        tell(f"the link carries {carried:.0f} Mbit/s")
        found = measure(
            WAYS, others, calls, Path(peers_python), absent, versions, tell, host=_SERVER, prefix=link.prefix
        )  # fmt: skip
    return {**found.to_json(), "link": {"rate": rate, "delay": delay, "measured_mbit_per_s": carried}}


def _interrupt_with_stdin() -> None:
    """Ctrl-C for this process when its standard input ends: whoever asked has gone, so everything is taken down."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=wait, daemon=True).start()


def main() -> None:
    """The process inside: its settings as JSON; lines of JSON with "tell", and one with "result" or "error"."""
    die_with_parent()
    out = own_stdout()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started all this with it ignored
    _interrupt_with_stdin()

    def say(**line: Any) -> None:
        print(json.dumps(line), file=out, flush=True)

    try:
        say(result=_inside(**json.loads(sys.argv[1]), tell=lambda text: say(tell=text)))
    except VLAgentsError as error:
        say(error=str(error))
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
