"""The common parts of the scripts: the line protocol, the policy, and ending a process when the
benchmark ends.

It imports only the standard library and numpy, as it runs in other environments.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

if TYPE_CHECKING:
    from benchmarks.closed_loop import ClosedLoop
    from benchmarks.line_client import obey, timed
    from vlagents_ray.serve.python_env.child_start import die_with_parent, own_stdout
else:  # The peers' Python has no vlagents_ray, so files are loaded by their paths.

    def _load(path: str) -> ModuleType:
        file = Path(__file__).parents[2] / path
        spec = importlib.util.spec_from_file_location(file.stem, file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    _LINES, _START = (
        _load("benchmarks/line_client.py"),
        _load("vlagents_ray/serve/python_env/child_start.py"),
    )
    die_with_parent, obey, own_stdout, timed = (
        _START.die_with_parent,
        _LINES.obey,
        _START.own_stdout,
        _LINES.timed,
    )
    ClosedLoop = _load("benchmarks/closed_loop.py").ClosedLoop

__all__ = ["Client", "Policy", "Target", "die_with_parent", "run", "wait_for_port"]

_START_S = 400.0

# This also works in processes that a script spawns.
if Path(sys.argv[0]).resolve().parent == Path(__file__).resolve().parent:
    die_with_parent()


class Policy:
    """A policy that returns seven numbers for each row of a batch; the first is the size of the
    batch.

    A batch of B takes `base_ms + per_item_ms * B`. Only one batch is computed at a time, as on an
    accelerator.

    Args:
        base_ms: Duration of a batch of any size, ms.
        per_item_ms: Additional duration for each row, ms.
        batch: Maximum size of a batch.
        chunk: Number of actions in an answer.
    """

    def __init__(
        self,
        base_ms: float = 0.0,
        per_item_ms: float = 0.0,
        batch: int = 1,
        chunk: int = 1,
    ) -> None:
        self.base_ms, self.per_item_ms, self.batch = base_ms, per_item_ms, batch
        self.chunk = chunk
        self._busy = threading.Lock()

    def __call__(self, rows: int = 1) -> np.ndarray:
        """Compute a batch, and return (rows, 7) float32, or (rows, chunk, 7) with several actions
        in an answer.
        """
        shape = (rows, 7) if self.chunk == 1 else (rows, self.chunk, 7)
        actions = np.zeros(shape, np.float32)
        actions[..., 0] = rows
        with self._busy:
            if taken := self.ms(rows):
                time.sleep(taken / 1e3)
        return actions

    def ms(self, rows: int) -> float:
        """Return the duration of a batch, ms."""
        return self.base_ms + self.per_item_ms * rows if self.base_ms or self.per_item_ms else 0.0

    def __reduce__(self) -> tuple[type[Policy], tuple[float, float, int, int]]:
        return Policy, (self.base_ms, self.per_item_ms, self.batch, self.chunk)


@dataclass(frozen=True, eq=False)
class Target:
    """The address of a server, and the data that its clients need."""

    host: str
    port: int
    # observation: camera_0, … (H, W, 3) uint8 RGB; joints (7,) float32; gripper () float64
    arrays: Mapping[str, np.ndarray]
    mode: str
    policy: Policy
    clients: int  # number of clients in this process

    @property
    def cameras(self) -> dict[str, np.ndarray]:
        return {name: image for name, image in self.arrays.items() if name.startswith("camera_")}

    @property
    def state(self) -> np.ndarray:
        """The joints and the gripper, (8,) float32."""
        return np.append(self.arrays["joints"], np.float32(self.arrays["gripper"]))


@dataclass(frozen=True)
class Client:
    """One connection. Only `act` is timed; it returns the policy's action, (7,)."""

    observe: Callable[[], Any]
    act: Callable[[Any], Any]
    close: Callable[[], None] = lambda: None
    # arguments of each run: number of clients, and end, s
    before: Callable[[int, float], None] = lambda _clients, _end: None


def end_with_stdin(end: Callable[[], None] = lambda: None) -> None:
    """End this process, a server, when its standard input ends, after calling `end`."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        end()
        os._exit(0)

    threading.Thread(target=wait, daemon=True).start()


def _stdin_has_ended() -> bool:
    """Return whether the parent of this process has ended, possibly before `die_with_parent` was
    called.
    """
    poller = select.poll()
    poller.register(0, select.POLLIN)
    return any(events & select.POLLHUP for _, events in poller.poll(0))


def wait_for_port(host: str, port: int) -> None:
    """Wait until a server listens; Raises `TimeoutError` after `_START_S`. Ends this process if its
    standard input ends.
    """
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
    serve: Callable[[str, int, Policy], None] | None,
    connect: Callable[[Target], Client],
    evaluate: Callable[[str, int, dict[str, Any]], None] | None = None,
    *,
    end: Callable[[], None] = lambda: None,
) -> None:
    """Run the command of a script.

    Its commands are `serve HOST PORT POLICY`; `drive HOST PORT OBS.npz MODE POLICY`, a client that
    makes calls in its turn; `load … ROBOTS SIMULATIONS`, with the same arguments before, clients
    that make load; `evaluate HOST PORT PLAN`, which writes a line when all its episodes have been
    run and all its processes have ended. POLICY and PLAN are JSON. Without `serve`, the clients'
    process starts the server. `end` ends processes that the server's process has started, if they
    do not end with it.
    """
    die_with_parent()
    out = own_stdout()
    command, host, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
    if command == "serve" and serve is not None:
        end_with_stdin(end)
        serve(host, port, Policy(**json.loads(sys.argv[4])))
    elif command == "evaluate" and evaluate is not None:
        end_with_stdin()
        os.register_at_fork(after_in_child=die_with_parent)
        evaluate(host, port, json.loads(sys.argv[4]))
        print(json.dumps({}), file=out, flush=True)
    else:
        if serve is not None:
            wait_for_port(host, port)
        with np.load(sys.argv[4], allow_pickle=False) as saved:
            arrays = {name: saved[name] for name in saved.files}
        robots, simulations = (int(word) for word in sys.argv[7:9] or (0, 1))
        policy = Policy(**json.loads(sys.argv[6]))
        target = Target(host, port, arrays, sys.argv[5], policy, robots + simulations)
        clients = [connect(target) for _ in range(target.clients)]
        try:
            if command == "drive":
                (client,) = clients
                obey(sys.stdin, out, lambda calls: timed(client.observe, client.act, calls), {})
            else:
                _make_load(clients, robots, policy, out)
        finally:
            for client in clients:
                client.close()


def _make_load(clients: list[Client], robots: int, policy: Policy, out: TextIO) -> None:
    """Answer each line, the arguments of `ClosedLoop.run`, with its calls."""

    def act(client: Client) -> tuple[float, float, int]:
        obs = client.observe()
        begun = time.perf_counter()
        rows = int(np.ravel(client.act(obs))[0])
        return (time.perf_counter() - begun) * 1e3, policy.ms(rows), rows

    loop = ClosedLoop([functools.partial(act, client) for client in clients], robots)
    print(json.dumps(True), file=out, flush=True)
    for line in sys.stdin:
        wanted = json.loads(line)
        for client in clients:
            client.before(wanted["robots"] + wanted["simulations"], wanted["end"])
        print(json.dumps(loop.run(**wanted)), file=out, flush=True)
