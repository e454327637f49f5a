"""Doors for other systems' clients over an engine without Ray, and what those clients send."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from starlette.testclient import TestClient

from vlagents_ray.interface import Agent
from vlagents_ray.serve.dialects.config import DialectArgs
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.routes import dialect_routes
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.ingress import build_ingress
from vlagents_ray.wire import openpi, openvla, vla_eval
from vlagents_ray.wire.messages import Limits

LIMITS = Limits(body_bytes=300_000, pixels=64 * 64)
METADATA = {"policy": "mirror", "version": "0", "protocol": 1, "checkpoint": None}
ALL: dict[str, Any] = {
    "openpi": {"mapping": "openpi-libero", "metadata": {"reset_pose": [0.5]}},
    "roboarena": {"mapping": "openpi-libero"},
    "openvla": {},
    "vla_eval": {"observation_params": {"send_state": True}},
}


@contextmanager
def serving(agent: Agent, dialects: dict[str, Any], **options: Any) -> Iterator[tuple[TestClient, Engine]]:
    engine = Engine(agent, **options)
    engine.start()
    routes = dialect_routes(DialectArgs(**dialects), House(engine, lambda: METADATA, LIMITS))
    with TestClient(build_ingress(engine, lambda: METADATA, LIMITS, dialects=routes)) as client:
        yield client, engine
    engine.close()


def image(pixel: int) -> np.ndarray:
    return np.full((8, 8, 3), pixel, np.uint8)


def libero(pixel: int, prompt: str | None = "task 1", **more: Any) -> bytes:
    state = np.array([0, 0, 0, 0, 0, 1, 0.04, -0.04])
    both = {"observation/image": image(pixel), "observation/wrist_image": image(0)}
    return openpi.encode({**both, "observation/state": state, "prompt": prompt, **more})


def call(socket: Any, data: bytes) -> Any:
    socket.send_bytes(data)
    return openpi.decode(socket.receive_bytes())


def body(pixel: int, instruction: str = "task 1", **more: Any) -> dict[str, Any]:
    return {"image": json.loads(openvla.encode(image(pixel), twice=False)), "instruction": instruction, **more}


def say(socket: Any, kind: Any, payload: dict[str, Any], seq: int) -> None:
    socket.send_bytes(vla_eval.encode(vla_eval.Message(kind, payload, seq)))


def hear(socket: Any) -> vla_eval.Message:
    return vla_eval.decode(socket.receive_bytes())


def seen(pixel: int, task: str = "task 1") -> dict[str, Any]:
    return {"images": {"front": image(pixel)}, "task_description": task, "state": np.ones(3)}
