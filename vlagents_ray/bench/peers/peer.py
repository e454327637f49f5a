"""What every script here needs: the line protocol, and that it ends with the benchmark.

A client writes one line of JSON when it is connected and warm. Then each line that it reads is a number
of calls to make, which it answers with a JSON list of their milliseconds. The end of its standard input
ends it, as does the death of its parent. Standard library and numpy only: it runs in other environments.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, TextIO

import numpy as np

WARM_UP = 20  # calls
_START_S = 60.0
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent dies, however that happens. Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def own_stdout() -> TextIO:
    """Return the standard output, for the protocol alone; what anything else prints goes to standard error."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return out


def end_with_stdin() -> None:
    """End this process, a server, as soon as its standard input ends."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        os._exit(0)

    threading.Thread(target=wait, daemon=True).start()


def timed(prepare: Callable[[], Any], call: Callable[[Any], object], calls: int) -> list[float]:
    """Make `calls` calls; returns the milliseconds of each, without those of `prepare`, which makes the observation."""
    taken = []
    for _ in range(calls):
        obs = prepare()
        begun = time.perf_counter()
        call(obs)
        taken.append((time.perf_counter() - begun) * 1e3)
    return taken


def obey(lines: Iterable[str], out: TextIO, measure: Callable[[int], list[float]], said: dict[str, Any]) -> None:
    """Warm up, say that it is ready (`said`), and answer each line until there is none."""
    measure(WARM_UP)
    print(json.dumps(said), file=out, flush=True)
    for line in lines:
        print(json.dumps(measure(int(line))), file=out, flush=True)


def observation(path: str) -> dict[str, np.ndarray]:
    """Load the observation: `camera_0`, … (H, W, 3) uint8 RGB; `joints` (7,) float32; `gripper` () float64."""
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _stdin_has_ended() -> bool:
    """Return whether the parent of this process has ended, maybe before `die_with_parent` was called."""
    poller = select.poll()
    poller.register(0, select.POLLIN)
    return any(events & select.POLLHUP for _, events in poller.poll(0))


def wait_for_port(host: str, port: int) -> None:
    """Wait until a server listens there; `TimeoutError` after a minute. Ends this process if its input ends."""
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

    PLAN is JSON; `evaluate` writes a line when all its episodes are played and everything that it started has ended.
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
