"""A process that looks like Ray's daemon."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

from eval_fakes import wait_for

from vlagents_ray.ray_tools.reaper import MARK


@contextlib.contextmanager
def raylet(folder: Path, ray_address: str, **environment: str) -> Iterator[None]:
    """Run a process that looks like the daemon of the Ray cluster whose private folder is `folder`."""
    folder.mkdir(exist_ok=True)
    words = ["/ray/raylet", "-c", "read forever", "raylet", f"--gcs-address={ray_address}", "--node_id=1"]
    with subprocess.Popen(
        words, executable="/bin/sh", env={MARK: str(folder)} | environment, stdin=subprocess.PIPE
    ) as process:
        try:
            wait_for(Path(f"/proc/{process.pid}/cmdline").read_bytes)  # which the kernel sets after Popen has returned
            yield
        finally:
            process.kill()
