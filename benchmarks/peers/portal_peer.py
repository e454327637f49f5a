"""portal: its `BatchServer`, with batching in a separate process (the default), and its `Client`.

The server waits without limit until a batch is full. There is therefore a method for each batch
size, and clients call the method for their number, or for the largest batch. The server polls
without a pause.
"""

from __future__ import annotations

import time

import numpy as np
import peer
import portal

_POLL_S = 0.25  # `Future.wait` can miss an answer that arrives when the wait begins.
_LATE_S = 0.5  # time for an answer after the end of a run, s


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server until the process ends."""
    portal.setup(host=host)
    server = portal.BatchServer(port)
    for size in range(1, policy.batch + 1):
        server.bind(f"act_{size}", lambda *arrays: policy(len(arrays[0])), batch=size)
    server.start()


def connect(target: peer.Target) -> peer.Client:
    """Connect portal's client."""
    obs = (*target.cameras.values(), target.state)
    client = portal.Client(f"{target.host}:{target.port}")
    method, deadline = "act_1", float("inf")

    def before(clients: int, end: float) -> None:
        nonlocal method, deadline
        method, deadline = f"act_{min(clients, target.policy.batch)}", end + _LATE_S

    def act(obs: tuple[np.ndarray, ...]) -> np.ndarray:
        future = client.call(method, *obs)
        while not future.done():
            if time.monotonic() > deadline:
                raise TimeoutError("the batch was not filled")
            future.wait(_POLL_S)
        return future.result()

    return peer.Client(lambda: obs, act, client.close, before)


if __name__ == "__main__":
    peer.run(serve, connect)
