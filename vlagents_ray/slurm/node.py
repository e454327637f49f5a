"""Ray on one node of a job, as long as the step lasts: `python -m vlagents_ray.slurm.node`."""

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
_AT_ONCE = {"RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S": "0"}  # Ray would wait 30 s for work that nobody goes on with
_HEAD_S = 120.0  # that the head may take to listen


def main() -> int:
    """Run it, and clean up behind it; returns its exit status at the head, whose end is the end of the step."""
    allocation = Allocation.here()
    head = os.environ[HEAD]
    if allocation.node:
        wait_for_head(head, allocation.ports.gcs)
    environment = os.environ | {"AUTOSCALER_METRIC_PORT": str(allocation.ports.metrics), **_AT_ONCE}
    asked = threading.Event()
    with tempfile.TemporaryDirectory(prefix=f"vlr-{allocation.job}-", dir=_SHORT, ignore_cleanup_errors=True) as folder:
        ray = subprocess.Popen(allocation.ray_start(head, folder), env=environment)  # noqa: S603 - made there

        def end(_number: int, _frame: FrameType | None) -> None:
            asked.set()
            ray.terminate()

        signal.signal(signal.SIGTERM, end)
        status = ray.wait()
    if asked.is_set():
        return 0
    sys.stdout.write(f"Ray ended with {status}\n")
    return 0 if allocation.node else status  # without another node the job goes on with those that are left


def wait_for_head(host: str, port: int, timeout_s: float = _HEAD_S) -> None:
    """Until Ray's head listens. Exits with what to look at if it does not in time."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            socket.create_connection((host, port), timeout=5).close()
        except OSError as error:
            if time.monotonic() > deadline:
                sys.exit(
                    f"Ray's head at {host}:{port} is not there after {timeout_s:g} s ({error}); see its node's log"
                )
            time.sleep(0.5)
        else:
            return


if __name__ == "__main__":
    sys.exit(main())
