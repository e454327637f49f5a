"""The program of a job's first node: it waits for Ray on all nodes, and then runs an evaluation or a policy server.

    python -m vlagents_ray.slurm.job_main eval [--fill CPUS] -- WORDS
    python -m vlagents_ray.slurm.job_main serve [--key] --app NAME=ROUTE... -- WORDS

WORDS are the arguments of `vlagents-ray eval` or `vlagents-ray serve`, which replaces this process.
"""

from __future__ import annotations

import argparse
import datetime
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.slurm.allocation import HEAD, Allocation
from vlagents_ray.slurm.node import wait_for_head

_NODES_S = 300.0  # time limit for all nodes to join
_COMMAND = "from vlagents_ray.cli import main; main()"  # runs with this Python, independent of PATH


def main() -> None:
    """Wait for Ray, and replace this process by the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["eval", "serve"])
    parser.add_argument(
        "--fill", type=float, metavar="CPUS", help="start workers of so many CPUs each on all CPUs but one"
    )
    parser.add_argument("--closing", type=float, default=0.0, help="s before the job's end, to end in order")
    parser.add_argument("--key", action="store_true", help="create an API key")
    parser.add_argument("--port", type=int, help="port of the server; by default derived from the job's number")
    parser.add_argument("--app", action="append", default=[], help="an application and its route")
    end_of_own = sys.argv.index("--")
    given = parser.parse_args(sys.argv[1:end_of_own])
    allocation, head = Allocation.here(), os.environ[HEAD]
    address = f"{head}:{allocation.ports.gcs}"
    wait_for_head(head, allocation.ports.gcs)
    cpus = wait_for_nodes(address, allocation.nodes)
    words = [*sys.argv[end_of_own + 1 :], f"--address={address}"]
    if given.what == "eval":
        end = end_of_job(allocation.job)
        words += ["--resume", "--replica-per-gpu"]
        if given.fill is not None:
            words += [f"--workers={max(1, int((cpus - 1) / given.fill))}", f"--worker-cpus={given.fill:g}"]
        words += [] if end is None else [f"--end-at={end - given.closing:.0f}"]
    else:
        words += _server_options(given, allocation)
    os.execv(sys.executable, [sys.executable, "-c", _COMMAND, given.what, *words])  # noqa: S606 - no shell


def wait_for_nodes(address: str, number: int, timeout_s: float = _NODES_S) -> int:
    """Wait until a number of nodes have joined the cluster.

    Args:
        address: The address of Ray's head, host:port.
        number: The number of nodes.
        timeout_s: The time limit, s; afterwards the process exits with a list of the nodes that joined.

    Returns:
        The number of CPUs of the cluster.
    """
    import ray

    deadline = time.monotonic() + timeout_s
    while not ray.is_initialized():
        try:
            ray.init(address=address, logging_level="ERROR", log_to_driver=False)
        except (ConnectionError, RuntimeError) as error:  # Ray does not run on this node yet
            if time.monotonic() > deadline:
                sys.exit(f"no Ray at {address} in {timeout_s:g} s: {error}")
    try:
        while len(alive := [node for node in ray.nodes() if node["Alive"]]) < number:
            if time.monotonic() > deadline:
                sys.exit(f"{len(alive)} of {number} nodes joined Ray in {timeout_s:g} s: {_names(alive)}; see the logs")
            time.sleep(0.5)
        sys.stdout.write(f"Ray runs on {_names(alive)}\n")
        sys.stdout.flush()
        return int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


def _names(nodes: list[dict[str, Any]]) -> str:
    found = sorted(((one["NodeManagerHostname"], one["Resources"]) for one in nodes), key=lambda one: one[0])
    return ", ".join(f"{name} ({has.get('CPU', 0):g} CPUs, {has.get('GPU', 0):g} GPUs)" for name, has in found)


def end_of_job(job: int) -> float | None:
    """Return the time at which Slurm ends the job, s since 1970; None if never. Newer versions set a variable."""
    if (variable := os.environ.get("SLURM_JOB_END_TIME")) is not None:
        return float(variable)
    command = ["squeue", "--noheader", f"--jobs={job}", "--format=%e"]
    end = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603
    return None if end in ("NONE", "Unknown", "N/A") else datetime.datetime.fromisoformat(end).timestamp()


def _server_options(given: argparse.Namespace, allocation: Allocation) -> list[str]:
    """Return the options of `serve` for its address and keys, and start the process that announces them."""
    from vlagents_ray.serve.access.key_store import new_key

    folder = Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent  # the job's folder, which only its user can read
    port = given.port or allocation.ports.serve
    words = ["--host=0.0.0.0", f"--port={port}"]
    key = ""
    if given.key:
        keys = folder / "keys.json"
        keys.unlink(missing_ok=True)  # keys of the same job before it was requeued
        key = new_key(keys, f"job-{allocation.job}")
        words.append(f"--keys={keys}")
    announcing = [sys.executable, "-m", "vlagents_ray.slurm.announce", str(folder), str(port), *given.app]
    subprocess.Popen(announcing, env=os.environ | {KEY_VARIABLE: key})  # noqa: S603 - our own arguments
    return words


if __name__ == "__main__":
    main()
