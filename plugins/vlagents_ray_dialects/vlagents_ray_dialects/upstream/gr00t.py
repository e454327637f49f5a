"""A client of GR00T's `PolicyServer`: one batch per message over ZeroMQ."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from vlagents_ray.errors import InvalidObservation, VLAgentsError
from vlagents_ray.registry import require
from vlagents_ray.wire.mapping import matches
from vlagents_ray_dialects.messages import gr00t as wire
from vlagents_ray_dialects.messages.gr00t import TEXT_KEY, is_flat, nested
from vlagents_ray_dialects.messages.outgoing import Outgoing
from vlagents_ray_dialects.upstream.client import Answer, ClientOptions, UpstreamClient


class GR00TClient(UpstreamClient):
    """A client of servers of N1.6 and newer, and of N1.5; N1.5's modality keys have the form
    `video.front`.

    If the mapping has such keys, the observation also has them, as `Gr00tSimPolicyWrapper` expects.
    """

    batches: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "gr00t"
    schemes: ClassVar[tuple[str, ...]] = ("tcp",)

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._zmq = require("zmq", extra="gr00t", distribution="vlagents-ray-dialects")
        self._context: Any = None
        self._socket: Any = None
        self._monitor: Any = None
        self._text_key = TEXT_KEY
        self._flat = False  # whether the server is an N1.5 server
        self._packed = False  # whether the server accepts arrays in the format of `msgpack_numpy`

    @property
    def is_open(self) -> bool:
        return self._socket is not None and not self._monitor.poll(0)

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect, and return the upstream's modalities."""
        zmq = self._zmq
        self._context = zmq.Context(io_threads=1)
        self._socket = self._context.socket(zmq.REQ)
        self._socket.setsockopt(zmq.LINGER, 0)
        # Do not queue messages for an upstream that is not connected.
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.MAXMSGSIZE, self.options.limits.body_bytes)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)

        try:
            self._socket.connect(self.options.url)
            reply = self._call("get_modality_config", None, timeout_s)
            self._flat = _is_flat(reply)
            self._packed = wire.reads_packed(reply)
            modalities = wire.read_modalities(reply)
        except (zmq.ZMQError, VLAgentsError) as error:
            self.close()
            raise self.unreachable(error) from error

        language = modalities.get("language")
        if language is not None and language["keys"]:
            self._text_key = language["keys"][0]
        return modalities

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        """Send a batch of observations, and return the actions of each."""
        flat = is_flat(observations[0])
        if flat:
            observations = [nested(observation) for observation in observations]
        try:
            batched = wire.batch(observations, self._text_key)
        except ValueError as error:
            raise InvalidObservation(
                f"gr00t: {error}; all sessions of a deployment must send the same keys and shapes"
            ) from error

        content = wire.flat(batched) if self._flat or flat else batched
        data = content if self._flat else {"observation": content, "options": None}
        reply = self._call("get_action", data, self.options.timeout_s)
        return list(wire.read_actions(reply, len(observations)))

    def begin(self) -> None:
        self._call("reset", None if self._flat else {"options": None}, self.options.timeout_s)

    def close(self) -> None:
        if self._socket is not None:
            self._socket.disable_monitor()
            self._monitor.close(linger=0)
            self._socket.close(linger=0)
            self._socket = None
        if self._context is not None:
            self._context.term()
            self._context = None

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        """Compare the upstream's modalities with the mapping: the keys of videos, states and
        actions, and the number of time steps.
        """
        differences = []
        mapping = outgoing.mapping
        camera_keys = [camera.key for camera in mapping.cameras.values()]
        state_keys: list[str] = []
        for state_entries in mapping.state.values():
            state_keys += [entry.key for entry in state_entries]

        for modality, field, keys in (
            ("video", "cameras", camera_keys),
            ("state", "state", state_keys),
        ):
            needed = metadata.get(modality, {"keys": [], "steps": []})
            sent_keys = []
            for key in keys:
                for alternative in key.split("|"):
                    name = alternative.removeprefix(f"{modality}/").removeprefix(f"{modality}.")
                    sent_keys.append(name)

            missing = []
            for key in needed["keys"]:
                if not any(matches(key, sent_key) for sent_key in sent_keys):
                    missing.append(key)

            if missing:
                differences.append(
                    f"{modality}: expected {missing}, which the upstream needs, got {sent_keys} "
                    f"in the mapping; add them to mapping.{field}"
                )
            if len(needed["steps"]) > 1:
                differences.append(
                    f"{modality}: expected one moment, as only the newest is sent, got "
                    f"{needed['steps']} from the upstream; serve a model that needs one"
                )

        names = metadata.get("action", {"keys": []})["keys"]
        wrong = [name for name in mapping.action if name not in names]
        if names and wrong:
            differences.append(
                f"action: the upstream gives {names}, mapping.action reads {wrong}; change it"
            )
        if len(names) > 1 and not mapping.action:
            differences.append(
                f"action: the upstream gives {names}; say in mapping.action which columns of ours "
                "each is"
            )
        return differences

    def chunk(self, metadata: Mapping[str, Any]) -> int | None:
        return len(metadata.get("action", {}).get("steps", ())) or None

    def _call(self, endpoint: str, data: Any, timeout_s: float) -> Any:
        """Send a request, and return the value of its reply."""
        if self._socket is None:
            raise self.closed()

        deadline = time.monotonic() + timeout_s
        message = wire.write(endpoint, data, self.options.key, packed=self._packed)
        try:
            self._wait(self._zmq.POLLOUT, deadline, "it accepts no connection")
            self._socket.send(message, self._zmq.NOBLOCK)
            self._wait(self._zmq.POLLIN, deadline, "no answer")
            payload = self._socket.recv(self._zmq.NOBLOCK)
        except self._zmq.ZMQError as error:
            raise self.lost(error) from error

        reply = wire.read(payload, self.options.limits)
        if isinstance(reply, dict) and "error" in reply:
            raise self.failed(reply["error"])
        return reply

    def _wait(self, event: int, deadline: float, failure: str) -> None:
        """Wait until the socket can be written or read; raise `ConnectionLost` if its connection
        ends first.
        """
        begun = time.monotonic()
        poller = self._zmq.Poller()
        poller.register(self._socket, event)
        poller.register(self._monitor, self._zmq.POLLIN)
        ready = dict(poller.poll(max(0.0, deadline - begun) * 1e3))
        if self._socket in ready:
            return
        if self._monitor in ready:
            raise self.lost("the connection ended")
        raise self.lost(f"{failure} within {deadline - begun:.3g} s")


def _is_flat(reply: Any) -> bool:
    """Return whether modalities have the keys of N1.5, which begin with the name of the
    modality.
    """
    video = reply.get("video") if isinstance(reply, dict) else None
    config = video.get("as_json", video) if isinstance(video, dict) else None
    if isinstance(config, str):
        return True
    if not isinstance(config, dict):
        return False
    return any(str(key).startswith("video.") for key in config.get("modality_keys", []))
