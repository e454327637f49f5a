"""Measures round trips over a real network link on one machine: two network namespaces, connected
by a shaped veth pair.

The servers run in one namespace, the clients in the other. A namespace ends with its last process,
and each process here ends with its parent or its standard input, so that nothing remains, however
the benchmark ends. Without root it runs in a user namespace, where the kernel allows that.
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks import peers as others
from benchmarks.console import Calls, Out, save, show_round_trips
from benchmarks.figures import measured_on
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.own_clients import OwnClient
from benchmarks.round_trips import measure
from vlagents_ray.cli.console import errors, progress
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout

RATE = "1gbit"
PEERS = ("vlagents", "openpi")
CLIENTS = (
    OwnClient("websocket", "raw"),
    OwnClient("websocket", "jpeg"),
    OwnClient("websocket", "auto"),
    OwnClient("http", "jpeg"),
)
INSIDE = "--inside"  # argument before JSON settings: this process is in the server's namespace
SHM = "vlagents shm"  # transports that do not cross a network
SERVER, _CLIENT = "10.197.44.1", "10.197.44.2"
_BULK = 64 * 2**20  # number of bytes that are sent to measure the link
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
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure round trips over a link, and its bandwidth.

    Args:
        calls: Number of round trips of each client.
        rate: The rate of the link, in the notation of `tc`.
        delay: The delay in each direction, in the notation of `tc`; None adds no delay.
        peers: Names of other policy servers, as in `measure_with_peers`.
        peers_python: The Python in which they are installed.
        progress: Is called with lines of progress.

    Returns:
        The result of `measure_with_peers`, and "link".

    Raises:
        ConfigError: This machine or user cannot make network namespaces; the message has the cure.
    """
    settings = {
        "calls": calls,
        "rate": rate,
        "delay": delay,
        "peers": list(peers),
        # Not resolved: a virtual environment's Python is a link.
        "peers_python": str(peers_python.absolute()),
    }
    measured: dict[str, Any] = run_inside("benchmarks.link", settings, progress)
    return measured


def run_inside(
    module: str, settings: Mapping[str, Any], progress: Callable[[str], None] = lambda _: None
) -> Any:
    """Run `python -m MODULE --inside SETTINGS` in a new network namespace, which is that of the
    server.

    Args:
        module: A module that calls `answer_from_inside` if its first argument is `INSIDE`.
        settings: The settings of the benchmark, as JSON values.
        progress: Is called with lines of progress.

    Returns:
        The result of the benchmark.

    Raises:
        ConfigError: This machine or user cannot make network namespaces; the message has the cure.
    """
    command = [*enter(), sys.executable, "-m", module, INSIDE, json.dumps(settings)]
    with LineProcess("the link", command, _environment(), end_s=_END_S) as process:
        while True:
            line = process.read(_RUN_S)
            if "progress" in line:
                progress(line["progress"])
            elif "error" in line:
                raise ConfigError(line["error"])
            else:
                return line["result"]


def _environment() -> dict[str, str]:
    """Return the environment variables with which a process finds the package and this folder."""
    ours = our_environment()["PYTHONPATH"]
    return {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), ours])}


def enter() -> list[str]:
    """Return the prefix that runs a command in a new network namespace, as root or in a user
    namespace.
    """
    if missing := [tool for tool in _TOOLS if shutil.which(tool) is None]:
        raise ConfigError(f"link: {', '.join(missing)} not found; install iproute2 and util-linux")
    refusals = []
    for command in (["unshare", "--net"], ["unshare", "--user", "--map-root-user", "--net"]):
        done = subprocess.run([*command, "true"], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return command
        refusals.append(done.stderr.strip())
    raise ConfigError(refused(refusals))


def refused(reasons: Sequence[str]) -> str:
    """Return the error message for users without the right to make namespaces, with the cure."""
    return (
        "link: cannot make a network namespace, neither as this user nor in a user namespace "
        f"({'; '.join(reasons)}); run it as root, or let users make them: sysctl "
        "kernel.unprivileged_userns_clone=1 (Debian), "
        "kernel.apparmor_restrict_unprivileged_userns=0 (Ubuntu)"
    )


class EmulatedLink:
    """The client's namespace, and the shaped link to it. It is created inside the server's
    namespace.
    """

    def __init__(self, rate: str, delay: str | None) -> None:
        self._holder = LineProcess("the client's namespace", ["unshare", "--net", "cat"])
        try:
            self._holder.request("1", 10)  # the answer shows that the process runs
            target = f"/proc/{self._holder.pid}/ns/net"
            self.prefix = ["nsenter", f"--net={target}"]
            _run(["ip", "link", "set", "lo", "up"])
            _run(["ip", "link", "add", "vlagents0", "type", "veth", "peer", "name", "vlagents1"])
            _run(["ip", "link", "set", "vlagents1", "netns", str(self._holder.pid)])
            for prefix, name, address in (
                ([], "vlagents0", SERVER),
                (self.prefix, "vlagents1", _CLIENT),
            ):
                _run([*prefix, "ip", "address", "add", f"{address}/24", "dev", name])
                _run([*prefix, "ip", "link", "set", name, "up"])
                for words in shaping(rate, delay):
                    _run([*prefix, "tc", "qdisc", "add", "dev", name, *words])
            # Ray uses the address of the default route; without this route, it would choose an
            # address that this namespace lacks.
            _run(["ip", "route", "add", "default", "via", _CLIENT])
        except BaseException:
            self._holder.close()
            raise

    def __enter__(self) -> EmulatedLink:
        return self

    def __exit__(self, *exc: object) -> None:
        self._holder.close()

    def megabits(self) -> float:
        """Measure the throughput of TCP from client to server, Mbit/s."""
        code = (
            f"import socket; s = socket.create_connection(({SERVER!r}, {{}})); "
            f"s.sendall(bytes({_BULK}))"
        )
        with socket.create_server((SERVER, 0)) as server:
            server.settimeout(30)
            command = [*self.prefix, sys.executable, "-c", code.format(server.getsockname()[1])]
            with subprocess.Popen(command) as sender:
                connection, _ = server.accept()
                with connection:
                    begun, got = time.perf_counter(), 0
                    while data := connection.recv(2**20):
                        got += len(data)
                    taken = time.perf_counter() - begun
                sender.wait(30)
        return got * 8 / taken / 1e6


def shaping(rate: str, delay: str | None) -> list[list[str]]:
    """Return the words of `tc qdisc add dev DEV …` for a link with this rate, and this delay in
    each direction.
    """
    if delay is None:
        return [["root", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"]]
    return [
        ["root", "handle", "1:", "netem", "delay", delay, "limit", "10000"],
        ["parent", "1:1", "tbf", "rate", rate, "burst", "64kb", "latency", "50ms"],
    ]


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(list(command), capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return
    reason = done.stderr.strip()
    if "netem" in command and "unknown" in reason:
        raise ConfigError(
            f"--delay: this kernel has no netem ({reason}); leave it out, or load the module "
            "sch_netem"
        )
    raise ConfigError(f"link: `{' '.join(command)}` failed: {reason}")


def _measure_inside(
    calls: int, rate: str, delay: str | None, peers: Sequence[str], peers_python: str, progress: Any
) -> Any:
    """Run the benchmark in the server's namespace."""
    python = Path(peers_python)
    clients, absent, versions = others.peer_clients(peers, python)
    clients = [one for one in clients if one.name != SHM]
    with EmulatedLink(rate, delay) as link:
        carried = link.megabits()
        progress(f"the link carries {carried:.0f} Mbit/s")
        starters = others.starters(clients, python, host=SERVER, prefix=link.prefix)
        found = measure(
            CLIENTS,
            calls,
            progress,
            others=starters,
            skipped=absent,
            host=SERVER,
            prefix=link.prefix,
        )
    made = {"rate": rate, "delay": delay, "measured_mbit_per_s": carried}
    return {**found.to_json(), "versions": versions, "link": made}


def _interrupt_with_stdin() -> None:
    """Interrupt this process, which ends the benchmark, when its standard input ends, since its
    parent has then ended.
    """

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=wait, daemon=True).start()


def answer_from_inside(measure: Callable[..., Any], settings: str) -> None:
    """Run a benchmark in this process, which `run_inside` started. It writes lines of JSON with
    "progress", then a line with "result" or "error".

    Args:
        measure: Is called with the settings, and with `progress`, a function that takes a line.
        settings: The settings as JSON.
    """
    die_with_parent()
    out = own_stdout()
    # A shell may have started this process with the signal ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _interrupt_with_stdin()

    def write(**line: Any) -> None:
        print(json.dumps(line), file=out, flush=True)

    try:
        result = measure(**json.loads(settings), progress=lambda text: write(progress=text))
        write(result=result)
    except VLAgentsError as error:
        write(error=str(error))
    except KeyboardInterrupt:
        sys.exit(130)


def main(
    calls: Calls = 600,
    rate: Annotated[str, typer.Option(help="Rate of the link, as tc writes it.")] = RATE,
    delay: Annotated[
        str | None,
        typer.Option(
            help="Delay in each direction, as tc writes it: 2ms. Needs the kernel's netem."
        ),
    ] = None,
    peers: others.Peers = "vlagents,openpi",
    peers_python: others.PeersPython = others.PYTHON,
    out_file: Out = None,
) -> None:
    """Measure round trips over a link of 1 Gbit/s between two network namespaces on this
    machine.
    """
    with errors():
        origin = measured_on("python -m benchmarks.link")
        found = measure_link(
            calls,
            rate=rate,
            delay=delay,
            peers=parse_list(peers),
            peers_python=peers_python,
            progress=progress,
        )
        show_round_trips(
            found, f"round trip of one act over {found['link']['measured_mbit_per_s']:.0f} Mbit/s"
        )
        save({**origin, **found, "versions": origin["versions"] | found["versions"]}, out_file)


if __name__ == "__main__":
    if sys.argv[1:2] == [INSIDE]:
        answer_from_inside(_measure_inside, sys.argv[2])
    else:
        typer.run(main)
