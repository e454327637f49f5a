"""The programs of a job, which `job.sh` starts.

    python -m vlagents_ray_cluster.slurm.job address
    python -m vlagents_ray_cluster.slurm.job node
    python -m vlagents_ray_cluster.slurm.job eval [--fill CPUS] -- WORDS
    python -m vlagents_ray_cluster.slurm.job serve [--key] --app NAME=ROUTE... -- WORDS
    python -m vlagents_ray_cluster.slurm.job announce FOLDER PORT NAME=ROUTE...

`address` prints the address of this node, on which Ray's head will run. `node` runs Ray on this
node until the step ends. `eval` and `serve` run on the first node. They wait for Ray on all nodes,
and are then replaced by `vlagents-ray eval` or `vlagents-ray serve` with the arguments WORDS.
`announce` waits until the server is ready, and prints how to reach it.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.ray_tools.session import FILES
from vlagents_ray.signals import StopRequest, delivered

# Variable with the address of the first node, exported by the job's script.
HEAD = "VLAGENTS_RAY_HEAD"
# The first port of all jobs, below the ports that the package and the system assign; the number of
# ports of a job; and the number of jobs with different ports.
_FIRST_PORT, _PORTS, _JOBS = 10_000, 5, 2_000
_COMMON_OPTIONS = ("--block", "--disable-usage-stats", "--log-color=false")
# Share of the job's memory for Ray's object store, which is in /dev/shm. Ray's default is 0.3 of
# the machine's memory.
_OBJECTS = 0.25
_SHORT = "/tmp"  # noqa: S108 - the names of Ray's sockets are limited to 107 bytes
# Without this, Ray would drain for 30 s, which is useless in a job that ends.
_NO_DRAIN = {"RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S": "0"}
_HEAD_S = 120.0  # time limit until the head listens, s
_NODES_S = 300.0  # time limit until all nodes have joined, s
_ATTEMPTS = 3  # to start Ray on a node
_STARTED = "ray_current_cluster"  # the file in Ray's folder with the address of a started cluster
# Runs the command line with this Python, whatever PATH contains.
_COMMAND = "from vlagents_ray.cli import main; main()"
FILE = "server.json"
_POLL_S = 0.5
_MOST_S = 3600.0  # time limit for loading the policies, s
_TEXT = """\
serving {names} in job {job}, until it ends; all of this, and the key, is in {file}
on the cluster's network:   {url}
from elsewhere, first:      {ssh}
                            and use http://localhost:{port} in its place

    {key}

    from vlagents_ray import Obs, RemoteAgent
    with RemoteAgent("{url}") as agent:
        agent.reset(obs, "pick up the cube")   # obs = Obs(cameras=..., state=...)
        print(agent.act(obs).action)
"""


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a job, derived from its number, so that jobs on the same node do not collide."""

    gcs: int  # Ray's head
    client: int  # Ray Client, which cannot be disabled
    metrics: int  # Ray's monitor, which cannot be disabled
    serve: int  # the policy server
    export: int  # export of each node's metrics, which Prometheus scrapes


def ports_of(job: int) -> Ports:
    """Return the ports of a job, the same on all its nodes."""
    first = _FIRST_PORT + job % _JOBS * _PORTS
    return Ports(*range(first, first + _PORTS))


@dataclass(frozen=True, slots=True)
class Allocation:
    """The resources of a job, as visible to a process on one of its nodes."""

    job: int
    nodes: int
    node: int  # number of this node, from 0; the head is 0
    cpus: int  # number of CPUs on this node
    gpus: int  # number of GPUs on this node
    memory: int | None  # memory on this node, bytes; None if Slurm does not manage memory

    @classmethod
    def here(cls, environ: Mapping[str, str] = os.environ) -> Allocation:
        """Return the resources of this process, from Slurm's environment variables."""
        cpus = int(environ["SLURM_CPUS_ON_NODE"])
        gpus = len(list(filter(None, environ.get("SLURM_STEP_GPUS", "").split(","))))
        # Slurm counts in MiB; 0 means all memory of the node.
        mebibytes = int(environ.get("SLURM_MEM_PER_NODE", "0"))
        if not mebibytes:
            mebibytes = int(environ.get("SLURM_MEM_PER_CPU", "0")) * cpus
        return cls(
            job=int(environ["SLURM_JOB_ID"]),
            nodes=int(environ["SLURM_JOB_NUM_NODES"]),
            node=int(environ.get("SLURM_NODEID", "0")),
            cpus=min(cpus, len(os.sched_getaffinity(0))),  # a task may be bound to fewer CPUs
            gpus=int(environ.get("SLURM_GPUS_ON_NODE", gpus)),
            memory=mebibytes * 2**20 or None,
        )

    @property
    def ports(self) -> Ports:
        """The ports of the job, the same on all nodes."""
        return ports_of(self.job)

    def ray_start(self, head: str, folder: str) -> list[str]:
        """Return the command that starts Ray on this node with the allocated resources.

        Args:
            head: The address of the first node.
            folder: A folder for Ray's files.
        """
        ports = self.ports
        command = ["ray", "start"]
        if self.node == 0:
            command += [
                "--head",
                f"--node-ip-address={head}",
                f"--port={ports.gcs}",
                "--include-dashboard=false",
                f"--ray-client-server-port={ports.client}",
            ]
        else:
            command.append(f"--address={head}:{ports.gcs}")

        command += [f"--num-cpus={self.cpus}", f"--num-gpus={self.gpus}"]
        if self.memory is not None:
            objects = int(self.memory * _OBJECTS)
            command += [f"--object-store-memory={objects}", f"--memory={self.memory - objects}"]

        command.append(f"--metrics-export-port={ports.export}")
        # The other listeners use free ports, since Ray's defaults are the same for every cluster.
        command += ["--min-worker-port=0", "--max-worker-port=0", "--dashboard-agent-listen-port=0"]
        return [*command, f"--temp-dir={folder}/{FILES}", *_COMMON_OPTIONS]


def run_node() -> int:
    """Run Ray on this node until the step ends, and remove Ray's files.

    If Ray does not start, the start is tried again: Ray's daemon waits at most 15 s for each of its
    helpers (ray issue 65983), which can be too short on a busy node.

    Returns:
        The exit status of the step. On the head it is that of Ray, unless Slurm has ended the step.
    """
    allocation = Allocation.here()
    head = os.environ[HEAD]
    node = _Node(allocation, head)
    with node.ended_by_slurm():
        for attempt in range(1, _ATTEMPTS + 1):
            if allocation.node:
                wait_for_head(head, allocation.ports.gcs)
            status, has_started = node.run_ray()
            if node.terminated.is_set():
                return 0
            if status == 0 or has_started or attempt == _ATTEMPTS:
                break
            sys.stdout.write(
                f"Ray ended with {status} while it started, trying again (attempt {attempt + 1} of "
                f"{_ATTEMPTS})\n"
            )
            sys.stdout.flush()

    sys.stdout.write(f"Ray ended with {status}\n")
    # The job continues without this node, unless it is the head.
    return 0 if allocation.node else status


class _Node:
    """Ray on this node.

    Args:
        allocation: The resources of the job on this node.
        head: The address of the first node.
    """

    def __init__(self, allocation: Allocation, head: str) -> None:
        self.terminated = StopRequest()  # Slurm has ended the step
        self._allocation = allocation
        self._head = head
        self._ray: subprocess.Popen[bytes] | None = None

    @contextlib.contextmanager
    def ended_by_slurm(self) -> Iterator[None]:
        """End Ray at SIGTERM within the context."""
        before = signal.signal(signal.SIGTERM, self._terminate)
        try:
            with delivered():
                yield
        finally:
            signal.signal(signal.SIGTERM, before)

    def run_ray(self) -> tuple[int, bool]:
        """Run Ray until it ends.

        Returns:
            The exit status of Ray, and whether it had started. A node that leaves the job in its
            first minutes has not: the head that it joined may have failed to start.
        """
        metrics_port = {"AUTOSCALER_METRIC_PORT": str(self._allocation.ports.metrics)}
        environment = os.environ | metrics_port | _NO_DRAIN
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(
            prefix=f"vlr-{self._allocation.job}-", dir=_SHORT, ignore_cleanup_errors=True
        ) as folder:
            command = self._allocation.ray_start(self._head, folder)
            self._ray = subprocess.Popen(command, env=environment)  # noqa: S603 - our own command
            if self.terminated.is_set():
                self._ray.terminate()
            status = self._ray.wait()
            if self._allocation.node:
                return status, time.monotonic() - begun > _NODES_S
            # `ray start` writes this file when all of Ray's processes run.
            return status, Path(folder, FILES, _STARTED).exists()

    def _terminate(self, _number: int, _frame: FrameType | None) -> None:
        self.terminated.set()
        if self._ray is not None:
            self._ray.terminate()


def wait_for_head(host: str, port: int) -> None:
    """Wait until Ray's head listens. After `_HEAD_S` the process exits with a message."""
    deadline = time.monotonic() + _HEAD_S
    while True:
        try:
            socket.create_connection((host, port), timeout=5).close()
        except OSError as error:
            if time.monotonic() > deadline:
                sys.exit(
                    f"Ray's head at {host}:{port} does not listen after {_HEAD_S:g} s ({error}); "
                    "see its log"
                )
            time.sleep(_POLL_S)
        else:
            return


def run_command(arguments: Sequence[str]) -> None:
    """Wait for Ray on all nodes, and replace this process with `vlagents-ray eval` or `serve`.

    Args:
        arguments: The arguments of this program, then "--", then the arguments of the command.
    """
    end_of_own = arguments.index("--")
    options = _command_options(arguments[:end_of_own])
    allocation, head = Allocation.here(), os.environ[HEAD]
    address = f"{head}:{allocation.ports.gcs}"
    wait_for_head(head, allocation.ports.gcs)
    cpus = wait_for_nodes(address, allocation.nodes)

    words = [*arguments[end_of_own + 1 :], f"--address={address}"]
    if options.command == "eval":
        words += _eval_words(options, allocation.job, cpus)
    else:
        words += _start_announcing(options, allocation)
    os.execv(sys.executable, [sys.executable, "-c", _COMMAND, options.command, *words])  # noqa: S606 - no shell


def _command_options(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("command", choices=["eval", "serve"])
    parser.add_argument(
        "--fill", type=float, metavar="CPUS", help="workers of so many CPUs each, on all but one"
    )
    parser.add_argument(
        "--closing-s", type=float, default=0.0, help="s before the job's end, to end in order"
    )
    parser.add_argument("--key", action="store_true", help="create an API key")
    parser.add_argument(
        "--port", type=int, help="port of the server; by default derived from the job's number"
    )
    parser.add_argument("--app", action="append", default=[], help="an application and its route")
    return parser.parse_args(arguments)


def _eval_words(options: argparse.Namespace, job: int, cpus: int) -> list[str]:
    """Return the arguments that the job adds to `vlagents-ray eval`, from its time and CPUs."""
    words = ["--resume", "--replica-per-gpu"]
    if options.fill is not None:
        workers = max(1, int((cpus - 1) / options.fill))
        words += [f"--workers={workers}", f"--worker-cpus={options.fill:g}"]
    end = end_of_job(job)
    if end is not None:
        words.append(f"--end-at={end - options.closing_s:.0f}")
    return words


def _start_announcing(options: argparse.Namespace, allocation: Allocation) -> list[str]:
    """Start `announce`, and return the arguments that the job adds to `vlagents-ray serve`.

    A new API key is created if the options say so.
    """
    from vlagents_ray.serve.access.key_store import new_key

    # The job's folder, which only its user can read.
    folder = Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent
    port, key = options.port or allocation.ports.serve, ""
    words = ["--host=0.0.0.0", f"--port={port}"]
    if options.key:
        keys = folder / "keys.json"
        keys.unlink(missing_ok=True)  # keys that were created before the job was requeued
        key = new_key(keys, f"job-{allocation.job}")
        words.append(f"--keys={keys}")

    command = [sys.executable, "-m", "vlagents_ray_cluster.slurm.job", "announce"]
    arguments = [str(folder), str(port), *options.app]
    subprocess.Popen([*command, *arguments], env=os.environ | {KEY_VARIABLE: key})  # noqa: S603 - our own arguments
    return words


def wait_for_nodes(address: str, number: int) -> int:
    """Wait until `number` nodes have joined Ray, and return the number of CPUs of the cluster.

    After `_NODES_S` the process exits with a message.
    """
    import ray

    deadline = time.monotonic() + _NODES_S
    while not ray.is_initialized():
        try:
            ray.init(address=address, logging_level="ERROR", log_to_driver=False)
        # Ray does not run on this node yet, or ends because it has not started in time. Ray raises
        # a plain Exception in some of these cases.
        except Exception as error:  # noqa: BLE001 - see above
            if time.monotonic() > deadline:
                sys.exit(f"no Ray at {address} in {_NODES_S:g} s: {error}")
            time.sleep(_POLL_S)
    try:
        while True:
            alive = [node for node in ray.nodes() if node["Alive"]]
            if len(alive) >= number:
                break
            if time.monotonic() > deadline:
                sys.exit(
                    f"{len(alive)} of {number} nodes joined Ray in {_NODES_S:g} s: "
                    f"{_names(alive)}; see the logs"
                )
            time.sleep(_POLL_S)

        sys.stdout.write(f"Ray runs on {_names(alive)}\n")
        sys.stdout.flush()
        return int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


def _names(nodes: list[dict[str, Any]]) -> str:
    """Return the names and resources of nodes as text."""
    descriptions = []
    for node in sorted(nodes, key=lambda node: node["NodeManagerHostname"]):
        name, resources = node["NodeManagerHostname"], node["Resources"]
        cpus, gpus = resources.get("CPU", 0), resources.get("GPU", 0)
        descriptions.append(f"{name} ({cpus:g} CPUs, {gpus:g} GPUs)")
    return ", ".join(descriptions)


def end_of_job(job: int) -> float | None:
    """Return the time at which Slurm ends the job, s since 1970; None if it has no limit."""
    # Newer versions of Slurm set this variable.
    variable = os.environ.get("SLURM_JOB_END_TIME")
    if variable is not None:
        return float(variable)

    command = ["squeue", "--noheader", f"--jobs={job}", "--format=%e"]
    end = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603
    if end in ("NONE", "Unknown", "N/A"):
        return None
    return datetime.datetime.fromisoformat(end).timestamp()


def announce(words: Sequence[str]) -> None:
    """Wait until each application is ready, write `server.json`, and print it to the job's log.

    Args:
        words: The folder of the file, the port, and NAME=ROUTE of each application.
    """
    folder, port = Path(words[0]), int(words[1])
    apps = dict(app.split("=", 1) for app in words[2:])
    health_urls = []
    for route in apps.values():
        health_urls.append(f"http://127.0.0.1:{port}{route.rstrip('/')}/healthz")

    deadline = time.monotonic() + _MOST_S
    server = os.getppid()
    while not all(map(_answers, health_urls)):
        has_ended = os.getppid() != server  # the server's log has the reason
        if has_ended or time.monotonic() > deadline:
            return
        time.sleep(_POLL_S)

    info = connection_info(apps, port, os.environ)
    write(folder / FILE, info)
    sys.stdout.write(as_text(info, folder / FILE))
    sys.stdout.flush()


def connection_info(
    apps: Mapping[str, str], port: int, environ: Mapping[str, str]
) -> dict[str, Any]:
    """Return the content of `server.json`.

    Args:
        apps: Name -> route of each application.
        port: The port of the server.
        environ: The environment variables of the job.

    Returns:
        The URL of each application, the API key, the command for an SSH tunnel, and the job.
    """
    host = socket.gethostname()
    url = f"http://{host}:{port}"
    login = environ.get("SLURM_SUBMIT_HOST", host)
    user = environ.get("SLURM_JOB_USER", environ.get("USER", ""))
    job = int(environ["SLURM_JOB_ID"])
    return {
        "job": job,
        "host": host,
        "address": environ[HEAD],
        "port": port,
        "url": url,
        "apps": {name: url + route.rstrip("/") for name, route in apps.items()},
        "metrics": f"http://{host}:{ports_of(job).export}/metrics",
        "key": environ.get(KEY_VARIABLE) or None,
        "ssh": f"ssh -N -L {port}:{host}:{port} {user}@{login}",
    }


def as_text(info: Mapping[str, Any], file: Path) -> str:
    """Return the connection info as text without the key, since other people may read the log.

    Args:
        info: The result of `connection_info`.
        file: The file that contains the key; the text has a command that reads the key from it.
    """
    url = next(iter(info["apps"].values()))
    key = f"export {KEY_VARIABLE}=(the key that you were given; none, if the server is --insecure)"
    if info["key"]:
        program = "import json, sys; print(json.load(open(sys.argv[1]))['key'])"
        key = f'export {KEY_VARIABLE}=$(python3 -c "{program}" {shlex.quote(str(file))})'
    names = ", ".join(info["apps"])
    return _TEXT.format(**{**info, "url": url, "key": key, "names": names, "file": file})


def write(file: Path, info: Mapping[str, Any]) -> None:
    """Write the connection info, which contains a key, atomically, readable only by its owner."""
    unfinished = file.with_suffix(".part")
    unfinished.touch(mode=0o600)
    unfinished.write_text(json.dumps(info, indent=2) + "\n")
    unfinished.replace(file)


def _answers(url: str) -> bool:
    """Return whether a URL answers with a status that is not an error."""
    with contextlib.suppress(OSError), urllib.request.urlopen(url, timeout=5):  # noqa: S310 - our own server
        return True
    return False


def main() -> None:
    """Run the program that the first argument names."""
    program, *words = sys.argv[1:]
    if program == "address":
        from ray.util import get_node_ip_address

        sys.stdout.write(f"{get_node_ip_address()}\n")
    elif program == "node":
        sys.exit(run_node())
    elif program == "announce":
        announce(words)
    else:
        run_command([program, *words])


if __name__ == "__main__":
    main()
