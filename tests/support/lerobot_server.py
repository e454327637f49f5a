"""A server of LeRobot's asynchronous inference, whose actions are those of `upstream_servers.answer`.

The format is that of LeRobot's async_inference/policy_server.py.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent import futures
from typing import Any

import grpc
import numpy as np
from lerobot_messages import Tensor, TimedAction, field_of, fields_in, pickled, unpickled
from upstream_servers import BROKEN, answer, obey


class PolicyServer:
    """As LeRobot's `PolicyServer`: one policy, one newest observation, whoever sends it; a failure answers nothing."""

    def __init__(self) -> None:
        self.queue: queue.Queue[Any] = queue.Queue(1)
        self.instructions: Any = None
        self.last: Any = None
        self.act_now = self.act
        self.wait_s = 2.0  # for an observation
        self.load_s = 0.0
        self.loads = 0

    def ready(self, _request: bytes, _context: Any) -> bytes:
        self.queue = queue.Queue(1)
        return b""

    def instruct(self, request: bytes, _context: Any) -> bytes:
        [(_, data)] = fields_in(request)
        time.sleep(self.load_s)
        self.instructions, self.loads = unpickled(data), self.loads + 1
        if self.instructions.pretrained_name_or_path == BROKEN:
            raise ValueError("a secret of the upstream")
        return b""

    def observe(self, parts: Iterator[bytes], _context: Any) -> bytes:
        seen = unpickled(b"".join(dict(fields_in(part))[2] for part in parts))
        if seen.must_go or self.last is None or seen.timestep != self.last.timestep:
            with contextlib.suppress(queue.Empty):
                self.queue.get_nowait()
            self.queue.put(seen)
        return b""

    def act(self, _request: bytes, _context: Any) -> bytes:
        with contextlib.suppress(Exception):
            seen = self.last = self.queue.get(timeout=self.wait_s)
            obey(seen.observation.get("task"))
            chunk = answer(self.frame(seen.observation)).astype(np.float32)
            rows = [
                TimedAction(seen.timestamp + i / 30, seen.timestep + i, Tensor(chunk, i)) for i in range(len(chunk))
            ]
            return field_of(1, pickled(rows, 4))
        return b""

    def frame(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """As LeRobot's build_dataset_frame."""
        found = {"task": values["task"]} if "task" in values else {}
        for key, feature in self.instructions.lerobot_features.items():
            if feature["dtype"] == "float32":
                found[key] = np.array([values[name] for name in feature["names"]], np.float32)
            else:
                found[key] = values[key.removeprefix("observation.images.")]
        return found


@contextlib.contextmanager
def serving(port: int) -> Iterator[PolicyServer]:
    """A server in this process; a test may put another method in place of its `act_now`."""
    served = PolicyServer()

    def act(request: bytes, context: Any) -> bytes:
        return served.act_now(request, context)

    unary, stream = grpc.unary_unary_rpc_method_handler, grpc.stream_unary_rpc_method_handler
    methods = {
        "Ready": unary(served.ready),
        "SendPolicyInstructions": unary(served.instruct),
        "SendObservations": stream(served.observe),
        "GetActions": unary(act),
    }
    handlers = [grpc.method_handlers_generic_handler("transport.AsyncInference", methods)]
    server = grpc.server(futures.ThreadPoolExecutor(4), handlers=handlers)
    server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    try:
        yield served
    finally:
        server.stop(None).wait()


def serve(port: int) -> None:
    """Serve until the process is killed."""
    with serving(port):
        threading.Event().wait()
