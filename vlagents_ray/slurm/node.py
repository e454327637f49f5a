"""Ray on one node of a job, as long as the step lasts: `python -m vlagents_ray.slurm.node`."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from types import FrameType

from vlagents_ray.slurm.allocation import HEAD, Allocation

_HEAD_S = 120.0  # that the head may take to listen


def main() -> int:
    """Run it, and clean up behind it; returns its exit status."""
    allocation = Allocation.here()
    head = os.environ[HEAD]
    if allocation.node:
        wait_for_head(head, allocation.ports.gcs)
    allocation.folder.mkdir(mode=0o700)  # fails if it is there: nobody else's is used
    environment = os.environ | {"AUTOSCALER_METRIC_PORT": str(allocation.ports.metrics)}
    try:
        ray = subprocess.Popen(allocation.ray_start(head), env=environment)  # noqa: S603 - made there

        def end(_number: int, _frame: FrameType | None) -> None:
            ray.terminate()

        signal.signal(signal.SIGTERM, end)
        return ray.wait()
    finally:
        shutil.rmtree(allocation.folder, ignore_errors=True)


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
