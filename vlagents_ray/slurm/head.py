"""What a job does at its first node, once Ray runs on all of them: an evaluation, or a policy server.

    python -m vlagents_ray.slurm.head eval [--fill CPUS] -- WORDS
    python -m vlagents_ray.slurm.head serve [--key] --app NAME=ROUTE... -- WORDS

WORDS are those of `vlagents-ray eval` and `vlagents-ray serve`, which take this process's place.
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

_NODES_S = 300.0  # that all nodes may take to join
_COMMAND = "from vlagents_ray.cli import main; main()"  # of this Python, whatever the PATH has


def main() -> None:
    """Wait for Ray, and become the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["eval", "serve"])
    parser.add_argument(
        "--fill", type=float, metavar="CPUS", help="as many workers as have so many CPUs each, less one CPU"
    )
    parser.add_argument("--closing", type=float, default=0.0, help="s before the job's end, for ending it")
    parser.add_argument("--key", action="store_true", help="make a key")
    parser.add_argument("--port", type=int, help="of the server; by default one derived from the job's number")
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
        words += _door(given, allocation)
    os.execv(sys.executable, [sys.executable, "-c", _COMMAND, given.what, *words])  # noqa: S606 - no shell


def wait_for_nodes(address: str, number: int, timeout_s: float = _NODES_S) -> int:
    """Until so many nodes have joined; returns the CPUs of all. Exits with who is there if it takes too long."""
    import ray

    deadline = time.monotonic() + timeout_s
    while not ray.is_initialized():
        try:
            ray.init(address=address, logging_level="ERROR", log_to_driver=False)
        except (ConnectionError, RuntimeError) as error:  # its own node is not there yet
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
    """When Slurm will end the job, in seconds since 1970; None if never. Newer ones say so by a variable."""
    if (said := os.environ.get("SLURM_JOB_END_TIME")) is not None:
        return float(said)
    command = ["squeue", "--noheader", f"--jobs={job}", "--format=%e"]
    end = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603
    return None if end in ("NONE", "Unknown", "N/A") else datetime.datetime.fromisoformat(end).timestamp()


def _door(given: argparse.Namespace, allocation: Allocation) -> list[str]:
    """The options of `serve` that say where it listens and whom it lets in; who tells that is started here."""
    from vlagents_ray.serve.keyfile import new_key

    folder = Path(os.environ["RAY_AUTH_TOKEN_PATH"]).parent  # of the job, for its user alone
    port = given.port or allocation.ports.serve
    words = ["--host=0.0.0.0", f"--port={port}"]
    key = ""
    if given.key:
        keys = folder / "keys.json"
        keys.unlink(missing_ok=True)  # of the same job, before it was requeued
        key = new_key(keys, f"job-{allocation.job}")
        words.append(f"--keys={keys}")
    telling = [sys.executable, "-m", "vlagents_ray.slurm.door", str(folder), str(port), *given.app]
    subprocess.Popen(telling, env=os.environ | {KEY_VARIABLE: key})  # noqa: S603 - our own words
    return words


if __name__ == "__main__":
    main()
