"""Servers for the tests of clients in other languages. They run a test policy in this process,
without Ray.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
from asgi_server import served
from in_memory_keys import ChangingKeys

from vlagents_ray.contract import Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine

ROWS = 4


class Told(Agent):
    """A policy whose actions contain the values that it received, so that a client can check that
    all of them arrived.

    Each of the ROWS rows of its chunk has: the number of earlier calls in the episode, the row's
    number, the gripper, the mean of the camera `front`, and the first number of the state `joints`;
    -1 for a missing value.
    """

    @property
    def contract(self) -> Contract:
        return Contract(chunk=ROWS, history=2)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._acts, self._observed = 0, 0
        return {"instruction": instruction, "kwargs": kwargs, "cameras": sorted(obs.cameras)}

    def observe(self, obs: Obs) -> None:
        self._observed += 1

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise RuntimeError("as requested")
        time.sleep(float(obs.info.get("sleep_s", 0.0)))
        gripper = -1.0 if obs.gripper is None else obs.gripper
        front = float(obs.cameras["front"].mean()) if "front" in obs.cameras else -1.0
        joint = float(obs.state["joints"][0]) if "joints" in obs.state else -1.0
        rows = [[self._acts, row, gripper, front, joint] for row in range(ROWS)]
        self._acts += 1
        info = {"observed": self._observed, "told": obs.info.get("tell")}
        return Act(np.array(rows, np.float32), info=info)


@contextlib.contextmanager
def client_servers() -> Iterator[dict[str, str]]:
    """Yield the environment variables that the tests of a client read.

    VLAGENTS_TEST_URL: a server whose replica has a port of its own; VLAGENTS_TEST_PROXIED_URL: the
    same policy without that port; VLAGENTS_TEST_KEYED_URL: the same behind API keys, of which
    VLAGENTS_TEST_KEY is one.
    """
    engine = Engine(Told())
    own = OwnPortServer(engine, DEFAULT_LIMITS, "127.0.0.1", None, NoKey.OPEN)
    own.open()
    engine.start()
    keys = ChangingKeys()
    contract = Told().contract.to_json()
    metadata: dict[str, Any] = {
        "policy": "told",
        "protocol": PROTOCOL_VERSION,
        "contract": contract,
        "stream": None,
    }

    def app(stream: Any, known: Any) -> AccessMiddleware:
        return AccessMiddleware(
            build_http_app(engine, lambda: metadata | {"stream": stream}, DEFAULT_LIMITS),
            known,
            "app",
        )

    with contextlib.ExitStack() as stack:
        stack.callback(engine.close)
        stack.callback(own.close)
        ports = {
            "VLAGENTS_TEST_URL": app(asdict(own.address), None),
            "VLAGENTS_TEST_PROXIED_URL": app(None, None),
            "VLAGENTS_TEST_KEYED_URL": app(None, keys.keys),
        }
        urls = {
            name: f"http://127.0.0.1:{stack.enter_context(served(each))}"
            for name, each in ports.items()
        }
        yield urls | {"VLAGENTS_TEST_KEY": keys.add("robot")}
