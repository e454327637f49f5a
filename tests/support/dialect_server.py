"""Dialects over an engine in this process, without Ray, and the messages of their clients."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from starlette.testclient import TestClient

from vlagents_ray.interface import Agent
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.registry import dialect_class, names
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext, RouteDialect, dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray_dialects.messages import openpi as openpi_codec
from vlagents_ray_dialects.messages import openvla as openvla_codec
from vlagents_ray_dialects.messages import vla_eval as vla_eval_codec
from vlagents_ray_dialects.messages import xpolicylab as xpolicylab_codec

LIMITS = MessageLimits(body_bytes=300_000, pixels=64 * 64)
METADATA = {"policy": "mirror", "version": "0", "protocol": 1, "checkpoint": None}
ALL: dict[str, Any] = {  # the dialects of the server's own port, with the settings that tests need
    **{name: {} for name in names("dialects") if issubclass(dialect_class(name), RouteDialect)},
    "openpi": {"mapping": "openpi-libero", "metadata": {"reset_pose": [0.5]}},
    "roboarena": {"mapping": "openpi-libero", "action_space": "joint_position"},
    "vla_eval": {"observation_params": {"send_state": True}},
}


@contextmanager
def serving(
    agent: Agent, dialects: dict[str, Any], keys: Keys | None = None, **options: Any
) -> Iterator[tuple[TestClient, Engine]]:
    engine = Engine(agent, EngineSettings(**options))
    engine.start()
    with client_of(engine, dialects, keys) as client:
        yield client, engine
    engine.close()


def client_of(engine: Engine, dialects: dict[str, Any], keys: Keys | None = None) -> TestClient:
    """Return a test client of the dialects over an engine."""
    routes = dialect_routes(
        DialectArgs(**dialects), ReplicaContext(engine, lambda: METADATA, LIMITS)
    )
    inside = build_http_app(engine, lambda: METADATA, LIMITS, more=routes)
    return TestClient(AccessMiddleware(inside, keys, "app"))


def image(pixel: int) -> np.ndarray:
    return np.full((8, 8, 3), pixel, np.uint8)


def libero(pixel: int, prompt: str | None = "task 1", **more: Any) -> bytes:
    state = np.array([0, 0, 0, 0, 0, 1, 0.04, -0.04])
    both = {"observation/image": image(pixel), "observation/wrist_image": image(0)}
    return openpi_codec.encode({**both, "observation/state": state, "prompt": prompt, **more})


def call(socket: Any, data: bytes) -> Any:
    socket.send_bytes(data)
    return openpi_codec.decode(socket.receive_bytes())


def body(pixel: int, instruction: str = "task 1", **more: Any) -> dict[str, Any]:
    return {
        "image": json.loads(openvla_codec.encode(image(pixel), twice=False)),
        "instruction": instruction,
        **more,
    }


def send(socket: Any, kind: Any, payload: dict[str, Any], seq: int) -> None:
    socket.send_bytes(vla_eval_codec.encode(vla_eval_codec.VlaEvalMessage(kind, payload, seq)))


def receive(socket: Any) -> vla_eval_codec.VlaEvalMessage:
    return vla_eval_codec.decode(socket.receive_bytes())


def seen(pixel: int, task: str = "task 1") -> dict[str, Any]:
    return {"images": {"front": image(pixel)}, "task_description": task, "state": np.ones(3)}


def xpolicylab(kind: str, message_id: str = "m-1", **payload: Any) -> bytes:
    """Return a message of an XPolicyLab client."""
    labels = {"evaluation_id": "evaluation", "trial_id": "trial"}
    return xpolicylab_codec.encode(xpolicylab_codec.Frame(kind, message_id, labels, payload))


def xpolicylab_observation(pixel: int, task: str = "task 1", **more: Any) -> dict[str, Any]:
    """Return an observation of an XPolicyLab client."""
    state = {"left_arm_joint_state": np.ones(3)}
    vision = {"cam_head": {"color": image(pixel)}}
    return {"vision": vision, "state": state, "instruction": task, **more}


def xpolicylab_error(data: bytes) -> str | None:
    """Return the error code in an answer to an XPolicyLab client; None if the answer is no error."""
    frame = xpolicylab_codec.decode(data, Budget(LIMITS))
    return frame.payload["details"]["code"] if frame.kind == "error" else None
