"""What crosses the wire, whatever carries it: a `Request` to a policy and its `Reply`."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import Act, Obs

PROTOCOL_VERSION = 1
SESSION_HEADER = "x-session-id"
REQUEST_ID_HEADER = "x-request-id"
MACHINE_HEADER = "x-boot-id"  # with GET /v1/metadata: the caller's machine, see `boot_id`, or
SERVERS_MACHINE = "server"  # that of whoever answers
DEADLINE_HEADER = "x-deadline-ms"
RANK_HEADER = "x-rank"
NAME_CHARACTERS = 128  # of a session's or a request's id, at most
STREAM_PATH = "/v1/stream/"  # on a replica's own port; something unguessable follows
STREAM_BYTES = 16 * 2**20  # of one WebSocket message: what uvicorn takes, and Serve does not let us change

Op = Literal["reset", "act", "close", "observe", "export", "adopt"]
OPS: tuple[Op, ...] = ("reset", "act", "close")
# What only a replica may ask of the process that runs its policy; "export" and "adopt" carry pickles.
INNER_OPS: tuple[Op, ...] = (*OPS, "observe", "export", "adopt")
RankName = Literal["robot", "simulation"]  # whose requests go first
RANKS: tuple[RankName, ...] = ("robot", "simulation")


@dataclass(slots=True)
class Request:
    """One call of `Agent.reset`, `Agent.act` or `Agent.close` on a remote policy, or one of `INNER_OPS`."""

    op: Op
    obs: Obs | None = None  # of reset, act and observe
    instruction: str | None = None  # reset only
    kwargs: dict[str, Any] = field(default_factory=dict)  # of reset: `seed`, ...; of adopt: what export answered
    contract: dict[str, Any] | None = None  # reset only: the robot's or env's side, compared by the server
    history: list[Obs] = field(default_factory=list)  # reset only: what the session saw since, oldest first
    session: str = ""  # which of its sessions the sender means; empty: the only one of its connection
    rank: RankName = "robot"
    step: int | None = None  # act only: how many acts the session has behind it, as far as the sender knows
    request_id: str = ""
    deadline_ms: float | None = None  # the answer is useless after this long, counted from its arrival


@dataclass(slots=True)
class Reply:
    """The answer to the request with the same id: an action, reset's info, or an error."""

    request_id: str = ""
    act: Act | None = None
    info: dict[str, Any] | None = None  # what `Agent.reset` returned
    error: VLAgentsError | None = None
    step: int | None = None  # acts that the session has behind it, this one included
    draining: bool = False  # the replica stops, or has too much to do: connect again, and the session follows
    timing: dict[str, float] = field(default_factory=dict)  # ms, by stage


@dataclass(frozen=True, slots=True)
class Limits:
    """What a decoder accepts; anything over is `MessageTooLarge` before memory is taken for it."""

    body_bytes: int = 64 * 2**20
    pixels: int = 4096 * 4096  # of one image
    cameras: int = 16
    state_values: int = 4096  # of one part of the proprioception
    depth: int = 8  # nesting of `info` and `kwargs`
    items: int = 10_000  # values in `info` and `kwargs` together
    text: int = 16_384  # characters of an instruction
    requests: int = 4096  # in one frame
    history: int = 256  # observations that come with a reset


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True, slots=True)
class LocalAddress:
    """Where processes on the server's own machine find it: `local` in the metadata."""

    socket: str  # name of a Unix socket in the abstract namespace, which no file system keeps
    boot_id: str  # of the machine, as Linux drew it when it started
    keyed: bool = False  # is the first message on a connection the client's API key? Only a refusal is answered

    # What a request brings lies in a memory file of the client's, handed over with the message that first
    # names it: a frame, or with COMPACT the arrays of the acts that follow the message's header (see
    # `vlagents_ray.wire.compact`). A reply follows its header, or lies in a memory file that comes with it.
    REQUEST: ClassVar[struct.Struct] = struct.Struct("<IIQ")  # number of the memory file, flags, bytes there
    REPLY: ClassVar[struct.Struct] = struct.Struct("<QHh")  # bit n: memory file n is free again; flags; core or -1
    IN_FILE: ClassVar[int] = 1  # flag: the frame of the reply lies in the memory file that comes with it
    COMPACT: ClassVar[int] = 2  # flag: no frame
    FILES: ClassVar[int] = 16  # of one client, which needs more than one if the policy keeps what it saw


@dataclass(frozen=True, slots=True)
class StreamAddress:
    """A port of the replica's own for WebSockets, on the host that answers for the server: `stream` in the metadata."""

    port: int
    path: str  # unguessable: only who may read the metadata knows it


@dataclass(frozen=True, slots=True)
class PlasmaAddress:
    """Where processes of the Ray cluster on the replica's node find it: `plasma` in what the replica tells them."""

    socket: str  # path of a Unix socket in Ray's folder
    node: str  # Ray's id of the node

    # Ray's id of the channel that holds the frame, or the arrays; flags as of `LocalAddress`.
    REQUEST: ClassVar[struct.Struct] = struct.Struct("<28sI")
    TAG: ClassVar[bytes] = b"VLA1"  # Ray's metadata of what is in the channel: out-of-band buffers, to be joined


def boot_id() -> str:
    """What tells this machine from others until it is restarted; empty where there is no Linux."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""
