"""Common parts of the scripts: the line protocol, and the end of a process with the benchmark.

It imports only the standard library and numpy, as it runs in other environments.
"""

from __future__ import annotations

import importlib.util
import json
import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

if TYPE_CHECKING:
    from vlagents_ray.bench.line_client import die_with_parent, obey, own_stdout, timed
else:  # the peers' Python has no vlagents_ray: the file is loaded by its path
    _FILE = Path(__file__).parents[2] / "vlagents_ray" / "bench" / "line_client.py"
    _SPEC = importlib.util.spec_from_file_location("line_client", _FILE)
    _MODULE = importlib.util.module_from_spec(_SPEC)
    _SPEC.loader.exec_module(_MODULE)
    die_with_parent, obey = _MODULE.die_with_parent, _MODULE.obey
    own_stdout, timed = _MODULE.own_stdout, _MODULE.timed

__all__ = ["die_with_parent", "obey", "observation", "own_stdout", "run", "timed", "wait_for_port"]

_START_S = 60.0


def end_with_stdin() -> None:
    """End this process, a server, as soon as its standard input ends."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os._exit(0)

    threading.Thread(target=wait, daemon=True).start()


def observation(path: str) -> dict[str, np.ndarray]:
    """Load the observation: `camera_0`, … (H, W, 3) uint8 RGB; `joints` (7,) float32; `gripper` () float64."""
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _stdin_has_ended() -> bool:
    """Return whether the parent of this process has ended, possibly before `die_with_parent` was called."""
    poller = select.poll()
    poller.register(0, select.POLLIN)
    return any(events & select.POLLHUP for _, events in poller.poll(0))


def wait_for_port(host: str, port: int) -> None:
    """Wait until a server listens; `TimeoutError` after a minute. Ends this process if its input ends."""
    deadline = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection((host, port), timeout=5).close()
        except OSError:
            if time.monotonic() > deadline:
                raise TimeoutError(f"no server listens on {host}:{port}") from None
            if _stdin_has_ended():
                sys.exit(0)
            time.sleep(0.1)
        else:
            return


def run(
    serve: Callable[[str, int], None],
    drive: Callable[[str, int, str, str, TextIO], None],
    evaluate: Callable[[str, int, dict[str, Any]], None] | None = None,
) -> None:
    """Run the command of a script: `serve HOST PORT`, `drive HOST PORT OBS.npz MODE`, `evaluate HOST PORT PLAN`.

    PLAN is JSON; `evaluate` writes a line when all its episodes are played and all its processes have ended.
    """
    die_with_parent()
    out = own_stdout()
    command, host, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
    if command == "serve":
        end_with_stdin()
        serve(host, port)
    elif command == "evaluate" and evaluate is not None:
        end_with_stdin()
        os.register_at_fork(after_in_child=die_with_parent)
        evaluate(host, port, json.loads(sys.argv[4]))
        print(json.dumps({}), file=out, flush=True)
    else:
        wait_for_port(host, port)
        drive(host, port, sys.argv[4], sys.argv[5], out)
