"""The messages of every transport: a `Request` to a policy and its `Reply`."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, VLAgentsError, shown
from vlagents_ray.interface import Act, Obs

PROTOCOL_VERSION = 1
SESSION_HEADER = "x-session-id"
REQUEST_ID_HEADER = "x-request-id"
# A header of GET /v1/metadata: the caller's machine (see `boot_id`), or `SERVERS_MACHINE`, which
# means the machine of the process that replies.
MACHINE_HEADER = "x-boot-id"
SERVERS_MACHINE = "server"
DEADLINE_HEADER = "x-deadline-ms"
# A header of a reply: the session's step. A request with this header is rejected if the session is
# at another step.
STEP_HEADER = "x-step"
PRIORITY_HEADER = "x-priority"
MOST_DEADLINE_MS = 1e9  # the longest deadline: 11 days
NAME_CHARACTERS = 128  # maximum length of a session's or a request's id
STREAM_PATH = "/v1/stream/"  # path on a replica's own port, followed by an unguessable name
# Maximum size of a WebSocket message: uvicorn's limit, which Serve does not allow to change.
STREAM_BYTES = 16 * 2**20


def is_name(text: str) -> bool:
    """Return whether a text is a valid session or request id, which consists of visible ASCII
    characters, so that it cannot forge a line in a log.
    """
    return (
        text.isascii() and text.isprintable() and " " not in text and len(text) <= NAME_CHARACTERS
    )


Op = Literal[
    "reset",
    "act",
    "close",
    "call",
    "export",
    "adopt",
    "weights",
    "release",
    "raise_step",
    "prepare",
    "gpu_memory",
    "gpu_work",
    "ability",
    "make_weights",
    "read_weights",
    "sleep",
    "wake",
]
OPS: tuple[Op, ...] = ("reset", "act", "close")
# These operations run while the policy computes actions, and use no session; see `BackgroundCalls`.
BACKGROUND_OPS: tuple[Op, ...] = ("ability", "make_weights", "read_weights", "sleep", "wake")
# The thread that reads these operations executes them immediately; they use no session of their
# connection.
IMMEDIATE_OPS: tuple[Op, ...] = ("prepare", "gpu_memory", "gpu_work")
# Only a replica may send these operations, to the process that runs its policy; "export" and
# "adopt" contain pickles.
INNER_OPS: tuple[Op, ...] = (
    *(*OPS, "call", "export", "adopt", "weights"),
    *IMMEDIATE_OPS,
    *BACKGROUND_OPS,
)
PriorityName = Literal["robot", "simulation"]


class Priority(IntEnum):
    """Priorities of requests, the most urgent first: robots are answered before simulations."""

    ROBOT = 0
    SIMULATION = 1


PRIORITIES: Mapping[PriorityName, Priority] = {
    "robot": Priority.ROBOT,
    "simulation": Priority.SIMULATION,
}


@dataclass(slots=True)
class Request:
    """One call of `Agent.reset`, `Agent.act` or `Agent.close` on a remote policy, or one of
    `INNER_OPS`.

    A decoded request is not modified, except by `drop_observations`. The class is not frozen, since
    creating a frozen instance takes three times as long (2.2 instead of 0.7 us).
    """

    op: Op
    # The observation of a reset, act or prepare; for call: the argument that is an observation.
    obs: Obs | None = None
    instruction: str | None = None  # reset only
    # For reset: `seed`, ...; for adopt: the reply to export; for weights: see `WeightUpdates.obey`;
    # for call and ability: see `AbilityCall`; for other `BACKGROUND_OPS`: see `BackgroundCalls`;
    # for prepare: the number under which the observation is stored. If `obs` is None, the stored
    # observation with that number is dropped.
    kwargs: dict[str, Any] = field(default_factory=dict)
    # Reset only: the contract of the robot or the environment, which the server compares with the
    # policy's contract.
    contract: dict[str, Any] | None = None
    # Reset only: earlier observations of the session, oldest first.
    history: list[Obs] = field(default_factory=list)
    session: str = ""  # id of the sender's session; empty for the only session of its connection
    priority: PriorityName = "robot"
    # For act and reset: the `step` of the last reply. An act is rejected if the session is at
    # another step.
    step: int | None = None
    request_id: str = ""
    # Time from the request's arrival after which the reply is of no use.
    deadline_ms: float | None = None
    # Act only: the number of an observation that "prepare" has stored, in place of `obs`; 0 for
    # none. Only a replica may send it, as for the operation "prepare".
    prepared: int = 0

    def drop_observations(self) -> None:
        """Drop the observations after use, since their memory may belong to the sender."""
        self.obs = None
        if self.history:
            self.history = []


@dataclass(slots=True)
class Reply:
    """The reply to the request with the same id: an action, the info of a reset, or an error."""

    request_id: str = ""
    act: Act | None = None
    info: dict[str, Any] | None = None  # the return value of `Agent.reset`
    error: VLAgentsError | None = None
    # The session's step: each act adds 1; a reset draws a number above all earlier steps.
    step: int | None = None
    # Whether the replica stops or is overloaded. The client should then reconnect, which moves its
    # session.
    draining: bool = False
    timing: dict[str, float] = field(default_factory=dict)  # ms, by stage

    def answers(self, request: Request) -> bool:
        """Return whether this is the reply to `request`, and not to an earlier request. A reply
        without an id, which answers an unreadable frame, counts as the reply.
        """
        return self.request_id in ("", request.request_id)

    @property
    def identity(self) -> dict[str, Any]:
        """Return the checkpoint, its digest and the commit of the weights, as far as the info of a
        reset contains them.
        """
        info = self.info or {}
        return {name: info[name] for name in ("checkpoint", "weights", "revision") if name in info}


@dataclass(frozen=True, slots=True)
class MessageLimits:
    """The limits of a decoder. A larger message raises `MessageTooLarge` before memory is allocated
    for it.
    """

    body_bytes: int = 64 * 2**20
    pixels: int = 4096 * 2304  # pixels of one image: 4K, for both television and cinema
    cameras: int = 16
    state_values: int = 4096  # values in one part of the state
    depth: int = 8  # nesting depth of `info` and `kwargs`
    items: int = 10_000  # total number of values in `info` and `kwargs`
    text: int = 16_384  # length of an instruction
    requests: int = 512  # requests in one frame
    history: int = 256  # observations sent with a reset
    # The decoded size of the images and bytes in one request, counted once for each reference to
    # them.
    decoded_bytes: int = 128 * 2**20
    # The size of all messages that a replica is processing, encoded and decoded.
    in_flight_bytes: int = 512 * 2**20


DEFAULT_LIMITS = MessageLimits()
# The largest action and info of one reply, in bytes. A larger reply would delay those of other
# sessions.
REPLY_BYTES = 16 * 2**20


@dataclass(frozen=True, slots=True)
class LocalAddress:
    """The address for processes on the server's machine. It is `local` in the metadata."""

    socket: str  # name of a Unix socket in the abstract namespace, not in a file system
    boot_id: str  # random id of the machine, which Linux draws at each boot
    # Whether the first message is the client's API key. The server replies to it only if the key is
    # rejected.
    keyed: bool = False

    # The data of a request are in a memory file of the client. The file's descriptor is sent with
    # the first message that refers to the file. The data are a frame or, with COMPACT, the arrays
    # of the acts that follow the message's header (see `vlagents_ray.protocol.compact`). A reply
    # follows its header, or is in a memory file whose descriptor is sent with the header.
    # REQUEST packs the number of the memory file, flags, and the number of bytes in it.
    REQUEST: ClassVar[struct.Struct] = struct.Struct("<IIQ")
    # REPLY packs a bit for each memory file, which is set if the file is free again, and flags.
    REPLY: ClassVar[struct.Struct] = struct.Struct("<QHxx")
    # A flag: the frame of the reply is in the memory file that is sent with the message.
    IN_FILE: ClassVar[int] = 1
    COMPACT: ClassVar[int] = 2  # a flag: the content is in compact form, not a frame
    # A ping is a message of one byte from the client; the server replies with another byte.
    PING: ClassVar[bytes] = b"?"
    PONG: ClassVar[bytes] = b"!"
    # Maximum number of memory files of a client. A policy that stores observations needs several
    # files.
    FILES: ClassVar[int] = 16


@dataclass(frozen=True, slots=True)
class StreamAddress:
    """The replica's own port for WebSockets and HTTP, on the host of the server's URL. It is
    `stream` in the metadata.
    """

    port: int
    # Path of the WebSocket; the paths for HTTP are below it. It is unguessable, so only clients
    # that may read the metadata know it.
    path: str

    def __post_init__(self) -> None:
        if not 0 < self.port < 2**16:
            raise MalformedMessage(
                f"metadata: stream: expected a port from 1 to 65535, got {self.port}"
            )
        if not (self.path.startswith(STREAM_PATH) and is_name(self.path)):
            raise MalformedMessage(
                f"metadata: stream: expected the path {STREAM_PATH} and a name, got "
                f"{shown(self.path)}"
            )


@dataclass(frozen=True, slots=True)
class PlasmaAddress:
    """The address for processes of the Ray cluster on the replica's node. It is `plasma` in the
    metadata of the replica.
    """

    socket: str  # path of a Unix socket in Ray's folder
    node: str  # Ray's id of the node

    # Ray's id of the channel that contains the frame or the arrays; flags as in `LocalAddress`.
    REQUEST: ClassVar[struct.Struct] = struct.Struct("<28sI")
    # The tag in Ray's metadata of the channel: the content is a list of out-of-band buffers to
    # concatenate.
    TAG: ClassVar[bytes] = b"VLA1"


Address = TypeVar("Address", LocalAddress, StreamAddress, PlasmaAddress)
_ADDRESS_TYPES = {"str": str, "int": int, "bool": bool}  # by the text of the annotation


def read_address(kind: type[Address], document: object) -> Address | None:
    """Read an address in the metadata of a server, which may be hostile; return None if the server
    has no such address.

    Args:
        kind: `LocalAddress`, `StreamAddress` or `PlasmaAddress`.
        document: The entry of the metadata. Further keys, which a newer server may send, are
            ignored.

    Raises:
        MalformedMessage: A key is missing, or its value has another type.
    """
    if document is None:
        return None
    if not isinstance(document, dict):
        raise MalformedMessage(
            f"metadata: expected the entries of a {kind.__name__}, got {shown(document)}"
        )

    values: dict[str, Any] = {}
    for entry in fields(kind):
        if entry.name not in document and entry.default is not MISSING:
            continue
        value = document.get(entry.name)
        if type(value) is not _ADDRESS_TYPES[str(entry.type)]:
            raise MalformedMessage(
                f"metadata: {kind.__name__}.{entry.name}: expected {entry.type}, got {shown(value)}"
            )
        values[entry.name] = value
    return kind(**values)


def boot_id() -> str:
    """Return an id that differs between machines and between their boots; empty on systems other
    than Linux.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def peer_uid(connection: socket.socket) -> int:
    """Return the user id of the process at the other end of a Unix socket, as the kernel reports
    it.
    """
    return peer_process(connection)[1]


def peer_process(connection: socket.socket) -> tuple[int, int]:
    """Return the process id and the user id at the other end of a Unix socket, as the kernel
    reports them.
    """
    credentials = connection.getsockopt(
        socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")
    )
    pid, uid, _ = struct.unpack("3i", credentials)
    return pid, uid


def is_loopback(host: str) -> bool:
    """Return whether `host` is an address of this machine that no other machine can reach."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a host name
        return host == "localhost"


# The cost of a message, which is checked before any of the message is decoded.


DecodedFiles = dict[int, tuple[np.ndarray, "bytes | memoryview"]]
"""Each image with the file from which it was decoded, by the `id` of the image."""
# Size of the parsed Python objects per byte of JSON, within the limits of `frame_layout`.
_JSON_FACTOR = 4
# Limit of the time to decode a request's images, s per byte of `decoded_bytes`. The limit suffices
# for PNG files that are slow to decode.
_DECODING_S = 20e-9
_LEAST_DECODING_S = 10e-3


class Budget:
    """The budget of one message. It checks declared sizes before an image is decoded or bytes are
    copied.

    This class enforces only the limits. A server uses the subclass
    `vlagents_ray.serve.engine.admission.MessageAdmission`, which also enforces the limits of the
    caller's key and of the replica's memory, and chooses the decoding thread.
    """

    __slots__ = ("_left", "_seconds_left", "files", "limits", "serial")

    def __init__(self, limits: MessageLimits) -> None:
        self.limits = limits
        self.serial = False  # whether images are decoded one after the other
        # Receives the files of decoded images; None if not needed.
        self.files: DecodedFiles | None = None
        self._refill()

    def begin_message(self) -> None:
        """Raise an error if the message is rejected, before any of it is parsed."""

    def parse(self, size: int) -> None:
        """Count the memory for the values of `size` bytes of JSON before they are parsed. This
        raises the errors of `hold`.
        """
        self.hold(_JSON_FACTOR * size)

    def begin(self, op: object, priority: object = "robot") -> None:
        """Begin the next request of the message after its header is parsed; raise an error if it is
        rejected.
        """
        self._refill()

    def _refill(self) -> None:
        """Set the budget of the next request."""
        self._left = self.limits.decoded_bytes
        self._seconds_left = _LEAST_DECODING_S + _DECODING_S * self.limits.decoded_bytes

    def count(self, size: int) -> None:
        """Count `size` bytes of the request that are already in memory.

        Raises:
            MessageTooLarge: The request exceeds the limit.
        """
        self._left -= size
        if self._left < 0:
            raise MessageTooLarge(
                f"request: expected images and bytes of at most {self.limits.decoded_bytes} bytes "
                "in all when decoded, got more (each counts as often as the request refers to "
                "it); send fewer or smaller images, or raise `limits.decoded_bytes`"
            )

    def hold(self, size: int) -> None:
        """Count `size` bytes before they are allocated for the request; raise an error if they
        exceed a limit.
        """
        self.count(size)

    @contextlib.contextmanager
    def decoding(
        self, seconds: float, scratch_bytes: int, *, is_bounded: bool = True
    ) -> Iterator[None]:
        """Count the decoding of images before it begins; raise an error if it exceeds a limit.

        Args:
            seconds: Estimated duration of the decoding on one core, s.
            scratch_bytes: Temporary memory of the decoding, in addition to the images, bytes.
            is_bounded: Whether all images are JPEG, whose pixels bound the duration.
        """
        self._seconds_left -= seconds
        if self._seconds_left < 0:
            raise MessageTooLarge(
                f"request: decoding its images takes {-self._seconds_left:.3g} s longer than "
                "allowed; send fewer or smaller images, or raise `limits.decoded_bytes`, to which "
                "the allowed time is proportional"
            )
        yield

    def examine(self, size: int) -> None:
        """Count `size` bytes of image files before their structure is checked."""

    def spend(self, seconds: float) -> None:
        """Count the CPU time that checking and decoding images took, s."""

    def image_of(self, _file: bytes) -> np.ndarray | None:
        """Return the image of the next file if it was decoded before the message was read again;
        None otherwise.
        """
        return None

    def keep_image(self, file: bytes, image: np.ndarray) -> None:
        """Keep the decoded image of the next file, in case the message has to be read again."""


# A probe tests the link. It is answered immediately, without a session or the policy. It consists
# of b"VLA?", an unused uint32, and any number of bytes to test the link with. It is one WebSocket
# message, with the limits of a request. The answer is b"VLA!" and the number of bytes that arrived,
# uint64 little-endian.

_HEAD_BYTES = 8  # size of the tag and the uint32
_PROBE_TAG, _ANSWER_TAG = b"VLA?", b"VLA!"
_ANSWER = struct.Struct("<4sQ")


def is_probe(message: bytes | memoryview) -> bool:
    """Return whether a message is a probe, which `probe_answer` answers."""
    return message[: len(_PROBE_TAG)] == _PROBE_TAG


def read_probe(message: bytes, budget: Budget) -> None:
    """Check a probe, which counts as one request of a simulation.

    Raises:
        MalformedMessage: The message is not a probe.
    """
    budget.begin_message()
    if not is_probe(message):
        raise MalformedMessage(f"probe: expected {_PROBE_TAG!r} at its start, got {message[:4]!r}")
    if len(message) < _HEAD_BYTES:
        raise MalformedMessage(f"probe: expected at least {_HEAD_BYTES} bytes, got {len(message)}")
    budget.begin("probe", "simulation")


def probe_answer(size: int) -> bytes:
    """Return the answer to a probe of `size` bytes."""
    return _ANSWER.pack(_ANSWER_TAG, size)
