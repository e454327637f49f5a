"""Runs Ray on one node of a job until the step ends: `python -m vlagents_ray.slurm.node`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from types import FrameType

from vlagents_ray.slurm.allocation import HEAD, Allocation

_SHORT = "/tmp"  # noqa: S108 - the names of Ray's sockets are limited to 107 bytes
_AT_ONCE = {"RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S": "0"}  # Ray would drain for 30 s, without use here
_HEAD_S = 120.0  # time limit for the head to listen


def main() -> int:
    """Run Ray and remove its files; the exit status of the head's Ray is that of the step."""
    allocation = Allocation.here()
    head = os.environ[HEAD]
    if allocation.node:
        wait_for_head(head, allocation.ports.gcs)
    environment = os.environ | {"AUTOSCALER_METRIC_PORT": str(allocation.ports.metrics), **_AT_ONCE}
    asked = threading.Event()
    with tempfile.TemporaryDirectory(prefix=f"vlr-{allocation.job}-", dir=_SHORT, ignore_cleanup_errors=True) as folder:
        ray = subprocess.Popen(allocation.ray_start(head, folder), env=environment)  # noqa: S603 - our own command

        def end(_number: int, _frame: FrameType | None) -> None:
            asked.set()
            ray.terminate()

        signal.signal(signal.SIGTERM, end)
        status = ray.wait()
    if asked.is_set():
        return 0
    sys.stdout.write(f"Ray ended with {status}\n")
    return 0 if allocation.node else status  # the job continues without a node that is not the head


def wait_for_head(host: str, port: int, timeout_s: float = _HEAD_S) -> None:
    """Wait until Ray's head listens; after `timeout_s` the process exits with a message."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            socket.create_connection((host, port), timeout=5).close()
        except OSError as error:
            if time.monotonic() > deadline:
                sys.exit(
                    f"Ray's head at {host}:{port} does not listen after {timeout_s:g} s ({error}); see its node's log"
                )
            time.sleep(0.5)
        else:
            return


if __name__ == "__main__":
    sys.exit(main())
