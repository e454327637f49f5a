"""The golden files of the protocol, for clients in any language: `python tests/support/golden.py`
writes them all.

The files are in clients/golden, whose README.md describes each of them.
tests/protocol/test_golden.py checks that the codec of this package writes each frame's bytes, and
reads the meaning stored next to the frame.
"""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import NotReset, Overloaded, UnknownSession, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.protocol.frame_layout import pack
from vlagents_ray.protocol.frames import describe_error, encode_replies, encode_requests
from vlagents_ray.protocol.json_messages import problem, reply_to_json
from vlagents_ray.protocol.messages import Reply, Request, probe_answer

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "clients" / "golden"
# written once, since another version of the encoder writes other bytes
JPEG_FILE = GOLDEN / "gray.jpg"

PIXELS = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)  # height 2, width 3, RGB
JOINTS = np.array([0.0, 0.25, -0.5, 1.0, -1.5, 2.0, 0.125], np.float32)
STEP = 4611686018427387905  # above 2**53, which some JSON parsers round
CHUNK = np.arange(14, dtype=np.float32).reshape(2, 7) / 8 - 0.5
TIMING = {
    "queue_ms": 0.125,
    "inference_ms": 8.25,
    "batch_size": 1,
    "decode_ms": 0.5,
    "encode_ms": 0.0625,
    "total_ms": 9.0,
}
WEIGHTS = {"policy": {"version": 0, "fingerprint": ""}}


@dataclass
class Golden:
    """A frame and its meaning."""

    name: str
    kind: str  # "requests", "replies", "malformed" (a reader rejects it), or "probe"
    says: str
    data: bytes
    meaning: Any = None
    by_codec: bool = False  # whether the codec of this package writes this frame


def png(pixels: np.ndarray) -> bytes:
    """Return a PNG file with uncompressed pixels, so that each version of zlib writes the same
    bytes.
    """

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    height, width, _ = pixels.shape
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    stored = b"\x78\x01\x01" + struct.pack("<HH", len(rows), len(rows) ^ 0xFFFF) + rows
    stored += struct.pack(">I", zlib.adler32(rows))
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", stored) + chunk(b"IEND", b"")
    )


def meaning(value: Any) -> Any:
    """Return a value as JSON without blobs; an object with the key `$` stands for a value that JSON
    cannot express.
    """
    if isinstance(value, np.ndarray):
        kind = value.dtype.newbyteorder("<").str
        return {
            "$": "array",
            "dtype": kind,
            "shape": list(value.shape),
            "values": meaning(value.ravel().tolist()),
        }
    if isinstance(value, float) and not math.isfinite(value):
        return {"$": "float", "value": str(value)}
    if isinstance(value, bytes):
        return {"$": "bytes", "base64": base64.b64encode(value).decode()}
    if isinstance(value, dict):
        return {key: meaning(item) for key, item in value.items()}
    if isinstance(value, list):
        return [meaning(item) for item in value]
    return value


def of_obs(obs: Obs) -> dict[str, Any]:
    """Return the meaning of an observation."""
    return {
        "cameras": meaning(obs.cameras),
        "gripper": obs.gripper,
        "state": meaning(obs.state),
        "info": meaning(obs.info),
    }


def of_request(request: Request) -> dict[str, Any]:
    """Return the meaning of a request, without fields that have their default."""
    default = Request(request.op)
    said = {
        name: value
        for name in (
            "instruction",
            "kwargs",
            "contract",
            "session",
            "priority",
            "request_id",
            "deadline_ms",
        )
        if (value := getattr(request, name)) != getattr(default, name)
    }
    found = {"op": request.op, **meaning(said)}
    if request.obs is not None:
        found["obs"] = of_obs(request.obs)
    if request.history:
        found["history"] = [of_obs(obs) for obs in request.history]
    if request.step is not None:
        found["step"] = str(request.step)
    return found


def of_reply(reply: Reply) -> dict[str, Any]:
    """Return the meaning of a reply."""
    found: dict[str, Any] = {"request_id": reply.request_id}
    if reply.error is not None:
        found["error"] = describe_error(reply.error)
    if reply.act is not None:
        found["act"] = {
            "action": meaning(reply.act.action),
            "done": reply.act.done,
            "info": meaning(reply.act.info),
        }
    if reply.info is not None:
        found["info"] = meaning(reply.info)
    if reply.step is not None:
        found["step"] = str(reply.step)
    if reply.draining:
        found["draining"] = True
    if reply.timing:
        found["timing"] = reply.timing
    return found


def frames() -> list[Golden]:
    """Return all frames."""
    return [*_requests(), *_replies(), *_from_the_future(), *_malformed(), *_probes()]


def _requests() -> list[Golden]:
    plain = Obs({"front": PIXELS}, 1.0, {"joints": JOINTS})
    reset = Request(
        "reset", plain, "push the cube", {"seed": 3}, request_id="r-1", session="robot-1"
    )
    act = Request(
        "act",
        plain,
        request_id="a-1",
        session="robot-1",
        priority="simulation",
        step=STEP,
        deadline_ms=1500.0,
    )
    kinds = ("|b1", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8")
    info = {
        "nothing": None,
        "yes": True,
        "whole": -7,
        "half": 0.5,
        "text": 'Würfel 方块 🤖 "quoted" \\ \n',
        "bytes": b"\x00\x01\xfe\xff\x80",
        "list": [1, [2.5, "three"], {}],
        "nan": math.nan,
        "infinite": [math.inf, -math.inf],
        "arrays": {kind: np.array([0, 1], kind) for kind in kinds},
        "empty": np.zeros((0, 3), np.float32),
        "scalar": np.array(2.5, np.float64),
    }
    contract = {"cameras": {"front": {"height": 2, "width": 3}}, "state": {"joints": {"dim": 7}}}
    earlier = Obs({}, 0.5, {"joints": JOINTS[:2]})
    several = [
        Request("act", Obs({"front": PIXELS}), session="env-0", request_id="0"),
        Request("act", Obs({"front": PIXELS[:1, :1]}, 0.0), session="env-1", request_id="1"),
    ]
    say = {
        "reset": ("a reset with raw pixels, a state and options", [reset]),
        "act": ("an act with a step over 2**53, a deadline and the priority of simulations", [act]),
        "act_shortest": ("an act without cameras or state", [Request("act", Obs())]),
        "close": ("a close", [Request("close", session="robot-1", request_id="c-1")]),
        "values": (
            "every value that `info` may hold",
            [Request("act", Obs(info=info), request_id="v")],
        ),
        "reset_contract": (
            "a reset with a contract and two earlier observations",
            [
                Request(
                    "reset",
                    Obs(state={"joints": JOINTS}),
                    "",
                    contract=contract,
                    history=[earlier, Obs()],
                )
            ],
        ),
        "several_requests": ("acts of two sessions in one frame", several),
    }
    written = [
        Golden(
            name,
            "requests",
            says,
            encode_requests(requests),
            [of_request(one) for one in requests],
            by_codec=True,
        )
        for name, (says, requests) in say.items()
    ]
    return [
        *written,
        _with_file("png", png(PIXELS), PIXELS),
        _with_file("jpeg", JPEG_FILE.read_bytes(), None),
    ]


def _with_file(format_: str, file: bytes, pixels: np.ndarray | None) -> Golden:
    obs: dict[str, Any] = {
        "cameras": {"front": {"$": ["img", 0]}},
        "gripper": None,
        "state": {"joints": [0.5, -1]},
    }
    camera: dict[str, Any] = {
        "$": "image",
        "format": format_,
        "base64": base64.b64encode(file).decode(),
    }
    if pixels is not None:
        camera["pixels"] = meaning(pixels)
    joints = meaning(np.array([0.5, -1.0], np.float32))
    means = {
        "op": "act",
        "request_id": format_,
        "obs": {"cameras": {"front": camera}, "gripper": None},
    }
    means["obs"] |= {"state": {"joints": joints}, "info": {}}  # type: ignore[operator]
    says = f"an act with a {format_.upper()} file, and a state as a list of numbers"
    return _packed(
        f"act_{format_}",
        "requests",
        says,
        {"op": "act", "obs": obs, "request_id": format_},
        [file],
        [means],
    )


def _packed(
    name: str,
    kind: str,
    says: str,
    header: dict[str, Any],
    blobs: Sequence[bytes] = (),
    means: Any = None,
) -> Golden:
    return Golden(name, kind, says, b"".join(pack(header, list(blobs))), means)


def _replies() -> list[Golden]:
    busy = Overloaded("the replica has no memory left; send it again later")
    busy.retry_after_s = 0.25
    unknown = UnknownSession("session 'robot-1': expired, closed, or never reset; reset it")
    odd = {
        "loss": math.nan,
        "distribution": {"std": np.array([0.5, np.inf], np.float32)},
        "raw": b"\x00\xff",
    }
    say: dict[str, tuple[str, list[Reply]]] = {
        "reset_reply": (
            "the answer to a reset",
            [Reply("r-1", info={"seed": 3}, step=STEP, timing=TIMING)],
        ),
        "act_reply": (
            "a chunk",
            [Reply("a-1", Act(CHUNK, info=WEIGHTS), step=STEP + 1, timing=TIMING)],
        ),
        "act_reply_one": ("one action, the last", [Reply("", Act(CHUNK[0], done=True))]),
        "act_reply_info": (
            "an action with an info of all sorts",
            [Reply("i", Act(CHUNK[0], info=odd))],
        ),
        "close_reply": ("the answer to a close", [Reply("c-1", info={})]),
        "draining": (
            "an answer of a replica that stops",
            [Reply("a-2", Act(CHUNK[0]), step=STEP + 2, draining=True)],
        ),
        "error": ("an error", [Reply("a-1", error=unknown)]),
        "error_retry": ("an error with a time to wait", [Reply("a-1", error=busy)]),
        "several_replies": (
            "the answers to two requests in one frame, the second of which failed",
            [
                Reply("0", Act(CHUNK[0]), step=7),
                Reply("1", error=NotReset("act before reset; call reset first")),
            ],
        ),
    }
    return [
        Golden(
            name,
            "replies",
            says,
            encode_replies(replies),
            [of_reply(one) for one in replies],
            by_codec=True,
        )
        for name, (says, replies) in say.items()
    ]


def _from_the_future() -> list[Golden]:
    """Return replies of a later server with the same protocol version; a client ignores their
    additions.
    """
    action = {"$": ["nd", 1, "<f4", [7]]}
    known = {"request_id": "f", "act": {"action": meaning(CHUNK[0]), "done": False, "info": {}}}
    failed = {"request_id": "f", "error": {"code": "melted", "detail": "too hot"}}
    header = {
        "later": {"$": ["bin", 0]},
        "request_id": "f",
        "act": {"action": action, "done": False, "info": {}, "also": 1},
        "timing": {},
    }
    return [
        _packed(
            "later_keys",
            "replies",
            "an answer with keys and a blob that version 1 does not name: a client ignores them",
            header,
            [b"later", CHUNK[0].tobytes()],
            [known],
        ),
        _packed(
            "later_code",
            "replies",
            "an error with a code that version 1 does not name: a client treats it as `internal`",
            {"request_id": "f", "error": {"code": "melted", "detail": "too hot", "also": 1}},
            means=[failed],
        ),
    ]


def _malformed() -> list[Golden]:
    good = encode_replies([Reply("a-1", Act(CHUNK), step=1)])
    length = struct.unpack_from("<I", good, 4)[0]
    far = {
        "request_id": "",
        "act": {"action": {"$": ["nd", 1, "<f4", [7]]}, "done": False, "info": {}},
    }
    short = {
        "request_id": "",
        "act": {"action": {"$": ["nd", 0, "<f4", [2]]}, "done": False, "info": {}},
    }
    objects = {
        "request_id": "",
        "act": {"action": {"$": ["nd", 0, "|O8", [1]]}, "done": False, "info": {}},
    }

    def of(header: bytes) -> bytes:
        return b"VLA\x01" + struct.pack("<I", len(header)) + header

    bad = {
        "bad_empty": ("no bytes", b""),
        "bad_prefix": ("six bytes", good[:6]),
        "bad_magic": ("another format", b"VLB" + good[3:]),
        "bad_version": ("version 2, which this side does not speak", good[:3] + b"\x02" + good[4:]),
        "bad_header_short": ("it ends inside its header", good[: 8 + length - 3]),
        "bad_header_long": (
            "the length of its header is 4 GiB",
            good[:4] + b"\xff\xff\xff\xff" + good[8:],
        ),
        "bad_header": ("its header is not JSON", of(b'{"blobs": [}')),
        "bad_header_list": ("its header is no object", of(b"[]")),
        "bad_no_blobs": ("its header has no `blobs`", of(b'{"request_id":""}')),
        "bad_blobs": ("a length is negative", of(b'{"request_id":"","blobs":[-8]}')),
        "bad_blob_short": ("it ends inside its blob", good[:-1]),
        "bad_end": ("a byte follows its last blob", good + b"\0"),
        "bad_utf8": ("its header is not UTF-8", of(b'{"request_id":"\xff","blobs":[]}')),
    }
    refused = {
        "bad_reference": ("the action refers to a blob that is not there", far),
        "bad_shape": ("the shape and type of the action name more bytes than its blob has", short),
        "bad_type": ("the action's type is none of the protocol", objects),
        "bad_act": ("an answer without an action", {"request_id": "", "act": {}}),
        "bad_replies": ("an empty list of answers", {"replies": []}),
    }
    return [
        *(Golden(name, "malformed", says, data) for name, (says, data) in bad.items()),
        *(
            _packed(name, "malformed", says, header, [b"\0" * (7 if name == "bad_shape" else 8)])
            for name, (says, header) in refused.items()
        ),
    ]


def _probes() -> list[Golden]:
    data = b"VLA?\0\0\0\0" + b"\x55" * 92
    return [
        Golden("probe", "probe", "a probe of 100 bytes", data, {"bytes": 100}),
        Golden("probe_answer", "probe", "its answer", probe_answer(100), {"arrived": 100}),
    ]


def documents() -> dict[str, Any]:
    """Return the JSON documents of HTTP by name. clients/schema/v1.json has the schema of each,
    under the first word of its name.
    """
    error = UnknownSession("session 'robot-1': expired, closed, or never reset; reset it")
    return {
        "reset_request": {"instruction": "push the cube", "gripper": 1.0, "kwargs": {"seed": 3}},
        "act_request": {
            "gripper": 1.0,
            "state": {"joints": JOINTS.tolist()},
            "info": {},
            "deadline_ms": 1500,
        },
        "act_request_shortest": {},
        "reset_answer": reply_to_json(Reply("r-1", info={"seed": 3}, timing=TIMING)),
        "act_answer": reply_to_json(Reply("a-1", Act(CHUNK[0], info=WEIGHTS), timing=TIMING)),
        "act_answer_chunk": reply_to_json(
            Reply(
                "a-1", Act(CHUNK, done=True, info={"loss": math.nan, "raw": b"\0"}), timing=TIMING
            )
        ),
        "close_answer": reply_to_json(Reply("c-1", info={}, timing=TIMING)),
        "problem": problem(error, "a-1"),
        "problem_overloaded": problem(Overloaded("no memory left; send it again later"), "a-1"),
        "problem_internal": problem(
            VLAgentsError("internal error; the server's log has the details"), "a-1"
        ),
    }


BOUNDARY = "golden-boundary"


def form() -> bytes:
    """Return the body of an act as `multipart/form-data` with the boundary BOUNDARY."""
    obs = b'{"gripper": 1.0, "state": {"joints": [0.5, -1]}}'
    head = b'--golden-boundary\r\nContent-Disposition: form-data; name="%s"'
    return b"".join(
        [
            head % b"obs",
            b"\r\nContent-Type: application/json\r\n\r\n" + obs + b"\r\n",
            head % b"cameras.front",
            b'; filename="front.png"\r\nContent-Type: image/png\r\n\r\n' + png(PIXELS) + b"\r\n",
            b"--golden-boundary--\r\n",
        ]
    )


def write(folder: Path) -> None:
    """Write all golden files into a folder."""
    for name in ("frames", "http"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    index = []
    for golden in frames():
        (folder / "frames" / f"{golden.name}.bin").write_bytes(golden.data)
        entry = {"file": f"frames/{golden.name}.bin", "kind": golden.kind, "says": golden.says}
        if golden.meaning is not None:
            _dump(folder / "frames" / f"{golden.name}.json", golden.meaning)
            entry["meaning"] = f"frames/{golden.name}.json"
        index.append(entry)
    for name, document in documents().items():
        _dump(folder / "http" / f"{name}.json", document)
    (folder / "http" / "act_form.bin").write_bytes(form())
    _dump(folder / "index.json", index)


def _dump(file: Path, value: Any) -> None:
    file.write_text(json.dumps(value, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    write(GOLDEN)
