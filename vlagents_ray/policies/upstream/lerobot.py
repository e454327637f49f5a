"""A client of LeRobot's `policy_server`: its asynchronous inference over gRPC, asked for one chunk at a time."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar
from urllib.parse import urlsplit

from vlagents_ray.errors import ConnectionLost, PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, UpstreamClient
from vlagents_ray.registry import require
from vlagents_ray.wire import lerobot

_LOST = ("UNAVAILABLE", "DEADLINE_EXCEEDED", "CANCELLED")  # the other status codes are answers
_OPTIONS = [
    ("grpc.enable_retries", 0),  # a server that was restarted has no policy: it must get its instructions first
    ("grpc.client_idle_timeout_ms", 2**31 - 1),
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.max_send_message_length", -1),
]
_POLLED_S = 5.0  # within which gRPC has looked at a channel's state once more: it does so every 0.2 s
_FIRST_STEPS = 2**29  # a connection counts from a random one below: no other client's answer is taken for its own


class LeRobotClient(UpstreamClient):
    """A client that has the server load a checkpoint, and then sends an observation and takes its chunk.

    The server keeps the newest observation of all its clients. Each of ours says `must_go`, without which the server
    leaves out one that is similar to the last one; and the answer repeats its time and its number, which are compared.
    """

    one_client: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "lerobot"
    schemes: ClassVar[tuple[str, ...]] = ("grpc",)
    takes_key: ClassVar[bool] = False

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._grpc = require("grpc")
        self._channel: Any = None
        self._observe: Callable[..., bytes] | None = None
        self._act: Callable[..., bytes] | None = None
        self._ended = threading.Event()
        self._watch: Callable[[Any], None] = lambda _: None
        self._step = 0

    @staticmethod
    def is_nested(key: str) -> bool:  # noqa: ARG004 - overrides
        """Return False: an observation is one flat map."""
        return False

    @property
    def is_open(self) -> bool:
        return self._channel is not None and not self._ended.is_set()

    def connect(self, timeout_s: float) -> dict[str, Any]:
        instructions = self.options.instructions
        if instructions is None:
            raise ValueError("lerobot: want instructions among the options")
        most = ("grpc.max_receive_message_length", self.options.limits.body_bytes)
        channel = self._channel = self._grpc.insecure_channel(urlsplit(self.options.url).netloc, [*_OPTIONS, most])
        unary = {name: channel.unary_unary(lerobot.method(name)) for name in ("Ready", "SendPolicyInstructions")}
        self._observe = channel.stream_unary(lerobot.method("SendObservations"))
        self._act = channel.unary_unary(lerobot.method("GetActions"))
        self._ended = ended = threading.Event()

        def watch(state: Any) -> None:
            """Note that the connection ended: gRPC opens another one by itself, to a server without a policy."""
            if state is not self._grpc.ChannelConnectivity.READY:
                ended.set()

        self._watch = watch
        try:
            self._call(unary["Ready"], lerobot.EMPTY, timeout_s)
            channel.subscribe(watch)
            setup = lerobot.write_data(lerobot.write_instructions(instructions))
            self._call(unary["SendPolicyInstructions"], setup, self.options.load_s)
        except ConnectionLost as error:
            raise PolicyUnavailable(f"{error}; is it running?") from error
        except VLAgentsError:
            self.close()
            raise
        self._step = random.randrange(_FIRST_STEPS)
        return {"policy_type": instructions.policy_type, "pretrained_name_or_path": instructions.checkpoint}

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        if self._observe is None or self._act is None or self.options.instructions is None:
            raise self.closed()
        deadline, now, self._step = time.monotonic() + self.options.timeout_s, time.time(), self._step + 1
        data = lerobot.write_observation(observation, self.options.instructions, now, self._step)
        self._call(self._observe, lerobot.write_observation_parts(data), self.options.timeout_s)
        reply = lerobot.read_data(self._call(self._act, lerobot.EMPTY, max(0.0, deadline - time.monotonic())))
        if not reply and not self.is_open:
            raise self.lost("it was restarted, and has no policy yet")
        if not reply:
            raise self.failed("no actions: its own log says why, unless another client took them")
        chunk = lerobot.read_chunk(reply, self.options.limits)
        if (chunk.timestamp, chunk.timestep) != (now, self._step):
            raise self.failed("the actions of another client's observation; it has one client at a time")
        return [chunk.rows]

    def close(self) -> None:
        channel, self._channel = self._channel, None
        self._observe = self._act = None
        if channel is None:
            return
        channel.unsubscribe(self._watch)
        # gRPC polls the state of a watched channel in a thread, which fails aloud if the channel is closed under it.
        end = time.monotonic() + _POLLED_S
        while getattr(getattr(channel, "_connectivity_state", None), "polling", False) and time.monotonic() < end:
            time.sleep(0.01)
        channel.close()

    def _call(self, method: Callable[..., bytes], message: Any, timeout_s: float) -> bytes:
        try:
            return method(message, timeout=timeout_s)
        except self._grpc.RpcError as error:
            code, text = error.code().name, error.details()
            if code not in _LOST:
                raise self.failed(f"{code}: {text}") from error
            late = code == "DEADLINE_EXCEEDED"
            raise self.lost(f"no answer within {timeout_s:.3g} s" if late else text) from error
