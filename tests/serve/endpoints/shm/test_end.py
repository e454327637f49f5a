"""The end of a local connection that is heard while the policy runs its batch."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from dataclasses import asdict
from typing import Any

import numpy as np
from eval_fakes import wait_for

from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.errors import ConnectionLost
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    Op,
    Reply,
    Request,
)
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine


class Gated(Agent):
    """Acts when the gate opens."""

    gate = threading.Event()
    busy = threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction = instruction
        return {}

    def act(self, obs: Obs) -> Act:
        Gated.busy.set()
        Gated.gate.wait(60)
        return Act(np.zeros(1), info={"instruction": self.instruction})


def call(transport: ShmTransport, op: Op, instruction: str | None = None) -> Reply:
    one = Request(op, Obs({}), instruction, request_id=os.urandom(8).hex())
    [reply] = transport.call([one], 60)
    return reply


def test_a_client_that_ends_while_its_batch_runs_harms_nobody() -> None:
    engine = Engine(Gated())
    endpoint = ShmServer(engine, DEFAULT_LIMITS, NoKey.OPEN)
    endpoint.open()
    engine.start()
    one, other = (ShmTransport(asdict(endpoint.address)) for _ in range(2))
    for each, name in ((one, "first"), (other, "second")):
        call(each, "reset", name)
    # The queue polls beside a batch once it has seen a slow one, and one before it that was another session's.
    for ending in (False, False, True):
        asking = one if ending else other
        Gated.gate, Gated.busy = threading.Event(), threading.Event()
        thread = threading.Thread(target=_act_to_the_end, args=(asking,))
        thread.start()
        try:
            assert Gated.busy.wait(60)
            if ending:
                asking._socket.shutdown(socket.SHUT_RDWR)  # type: ignore[union-attr]
                wait_for(lambda: len(engine.sessions) == 1, 50)  # while the batch is under way
            else:
                time.sleep(0.02)
        finally:
            Gated.gate.set()
            thread.join(60)
    act = call(other, "act").act
    assert act is not None
    assert act.info.pop("policy")["version"] == 0
    assert act.info == {"instruction": "second"}
    one.close()
    other.close()
    engine.close()
    endpoint.close()


def _act_to_the_end(transport: ShmTransport) -> None:
    with contextlib.suppress(ConnectionLost):
        call(transport, "act")
