"""A robot of LeRobot's remote inference over Zenoh, which uses the protocol of LeRobot's client."""

from __future__ import annotations

import queue
import threading
import time
import uuid
from types import TracebackType
from typing import Any

import numpy as np
import zenoh
from zenoh_session import open_zenoh

from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import Envelope

SEMANTICS = "SO-101, degrees"
STATE = {"name": "observation.state", "shape": [3], "names": ["a", "b", "c"], "semantics": "deg"}
FRONT = {
    "name": "observation.images.front",
    "shape": [8, 8, 3],
    "dtype": "uint8",
    "kind": "rgb",
    "semantics": "the camera in front",
}
ACTION = {"name": "action", "shape": [5], "semantics": "deg"}
SETTINGS: dict[str, Any] = {
    "deployment": "so101",
    "semantics": SEMANTICS,
    "features": [FRONT, STATE],
    "action": ACTION,
    "fps": 10,
    "steps": 2,
}
_WAIT_S = 20.0


def on_wire(feature: dict[str, Any]) -> dict[str, Any]:
    """Return a feature with all fields that LeRobot's client sends."""
    return {"dtype": "float32", "kind": "tensor", "names": [], **feature}


def rgb(image: np.ndarray, **changes: Any) -> dict[str, Any]:
    """Return the record of an RGB image."""
    return {
        "__lerobot_type__": "rgb",
        "encoding": "raw",
        "shape": list(image.shape),
        "dtype": "uint8",
        "channel_order": "RGB",
        "data": image.tobytes(),
        **changes,
    }


class RemoteRobot:
    """One client, from its connection to the end of its session."""

    def __init__(self, port: int, deployment: str = "so101") -> None:
        self._zenoh = open_zenoh(port)
        self._declared: list[Any] = []  # Zenoh undeclares objects without a reference
        self._key = f"lerobot/inference/v1/deployments/{deployment}"
        self.answers: queue.Queue[Envelope] = queue.Queue()
        self.session_id, self.generation, self.sequence = "", 0, 0
        self.descriptor = self.query(
            f"{self._key}/describe", Envelope("describe", request_id=uuid.uuid4().hex)
        ).body
        self.instance_id = str(self.descriptor["instance_id"])
        self.instance_key = f"{self._key}/instances/{self.instance_id}"
        self.presence: queue.Queue[bool] = queue.Queue()
        alive = self._zenoh.liveliness().declare_subscriber(
            f"{self.instance_key}/alive",
            self._direct(lambda sample: self.presence.put(sample.kind == zenoh.SampleKind.PUT)),
            history=True,
        )
        self._declared.append(alive)

    def __enter__(self) -> RemoteRobot:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.leave()

    def leave(self) -> None:
        """Close the connection without a message, like a robot that loses its network."""
        if self._zenoh is not None:
            self._zenoh.close()
            self._zenoh = None

    def query(self, key: str, request: Envelope | bytes) -> Envelope:
        """Send a query, and return its only reply."""
        data = messages.encode(request) if isinstance(request, Envelope) else request
        with self._zenoh.declare_querier(key) as querier:
            deadline = time.monotonic() + _WAIT_S
            while not querier.matching_status.matching:
                assert time.monotonic() < deadline, f"no server answers at {key}"
                time.sleep(0.005)

        replies: list[bytes] = []
        is_over = threading.Event()
        self._zenoh.get(
            key,
            zenoh.handlers.Callback(
                lambda reply: replies.append((reply.ok or reply.err).payload.to_bytes()),
                drop=is_over.set,
                indirect=False,
            ),
            payload=data,
            timeout=_WAIT_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        assert is_over.wait(_WAIT_S)
        [reply] = replies
        return messages.decode(reply)

    def open_body(self, **changes: Any) -> dict[str, Any]:
        """Return the body of a request for a session."""
        return {
            "expected_artifact": self.descriptor["artifact_identity"],
            "features": [on_wire(FRONT), on_wire(STATE)],
            "action_feature": on_wire(ACTION),
            "semantics": SEMANTICS,
            "action_interval": 0.1,
            "mode": "chunk",
            "encoding": "raw",
            **changes,
        }

    def open(self, request_id: str = "", **changes: Any) -> Envelope:
        """Request a session."""
        request = Envelope(
            "open",
            self.instance_id,
            request_id=request_id or uuid.uuid4().hex,
            body=self.open_body(**changes),
        )
        return self.query(f"{self.instance_key}/open", request)

    def begin(self, request_id: str = "", **changes: Any) -> RemoteRobot:
        """Open a session and reset it, as LeRobot's client does."""
        self.accepted = self.open(request_id, **changes)
        assert self.accepted.message_type == "accepted", self.accepted
        self.session_id = self.accepted.session_id
        key = self.session_key
        for suffix in ("act", "language/result"):
            subscriber = self._zenoh.declare_subscriber(
                f"{key}/{suffix}",
                self._direct(lambda s: self.answers.put(messages.decode(s.payload.to_bytes()))),
            )
            self._declared.append(subscriber)
        self._declared.append(self._zenoh.liveliness().declare_token(f"{key}/alive"))
        assert self.control("reset").message_type == "ack"
        for suffix in ("obs", "language/request"):
            self._await_subscriber(f"{key}/{suffix}")
        return self

    @property
    def session_key(self) -> str:
        return f"{self.instance_key}/sessions/{self.session_id}"

    def control(self, operation: str, generation: int | None = None) -> Envelope:
        """Request a control operation."""
        self.generation = self.generation if generation is None else generation
        request = Envelope(
            "control",
            self.instance_id,
            self.session_id,
            self.generation,
            uuid.uuid4().hex,
            {"operation": operation},
        )
        return self.query(f"{self.session_key}/control", request)

    def answer_to(self, kind: str, data: bytes) -> Envelope:
        """Send the bytes of an observation (`obs`), of a control message (`control`) or of a
        question (`open`, `describe`), and return the answer.
        """
        if kind == "obs":
            self.publish("obs", data)
            return self.answers.get(timeout=_WAIT_S)
        keys = {"control": self.session_key, "open": self.instance_key, "describe": self._key}
        return self.query(f"{keys[kind]}/{kind}", data)

    def send(self, pixel: int, task: str = "abc", features: Any = None, **changes: Any) -> Envelope:
        """Publish an observation."""
        request = self.observation(pixel, task, features, **changes)
        self.publish("obs", messages.encode(request))
        return request

    def observation(
        self, pixel: int, task: str = "abc", features: Any = None, **changes: Any
    ) -> Envelope:
        """Return the next observation."""
        self.sequence += 1
        image = np.full((8, 8, 3), pixel, np.uint8)
        if features is None:
            features = {
                FRONT["name"]: rgb(image),
                STATE["name"]: np.array([0.5, 1, 2], np.float32),
            }
        body = {
            "sequence": self.sequence,
            "artifact_identity": self.descriptor["artifact_identity"],
            "observation_id": f"o{self.sequence}",
            "capture_time": 12.5,
            "task": task,
            "task_version": 3,
            "features": features,
            "delay": 0,
            "model_continuation": None,
            "canonical_continuation": None,
            "cursor": 0,
            **changes,
        }
        return Envelope(
            "observation",
            self.instance_id,
            self.session_id,
            self.generation,
            f"r{self.sequence}",
            body,
        )

    def publish(self, suffix: str, data: bytes, **options: Any) -> None:
        self._zenoh.put(f"{self.session_key}/{suffix}", data, **options)

    def act(self, pixel: int, task: str = "abc", **changes: Any) -> Envelope:
        """Send an observation, and return the answer."""
        request = self.send(pixel, task, **changes)
        answer = self.answers.get(timeout=_WAIT_S)
        expected = (request.instance_id, request.session_id, request.generation, request.request_id)
        assert expected == (
            answer.instance_id,
            answer.session_id,
            answer.generation,
            answer.request_id,
        )
        return answer

    def _await_subscriber(self, key: str) -> None:
        with self._zenoh.declare_publisher(key) as publisher:
            deadline = time.monotonic() + _WAIT_S
            while not publisher.matching_status.matching:
                assert time.monotonic() < deadline, f"no subscriber at {key}"
                time.sleep(0.005)

    @staticmethod
    def _direct(function: Any) -> Any:
        return zenoh.handlers.Callback(function, indirect=False)
