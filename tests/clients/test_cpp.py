"""The C++ client (clients/cpp) with a real server, the golden files, and servers that violate the
protocol.
"""

from __future__ import annotations

import base64
import http
import json
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asgi_server import policy_server, served
from cpp_client import CppClient, CppError, build
from eval_fakes import wait_for
from golden import GOLDEN, of_request
from hostile_messages import ADDED_MB, ANSWERS
from in_flight import read_requests
from in_memory_keys import ChangingKeys
from raptor import Raptor
from raptor_flights import TOLERANCE, observation, reference
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.sync.server import ServerConnection, serve

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.errors import Overloaded
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.protocol.frames import decode_requests, encode_replies
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    PROTOCOL_VERSION,
    Budget,
    MessageLimits,
    Reply,
    Request,
)
from vlagents_ray.serve import periodic
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints import access_middleware
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import free_port

Script = Callable[["Visit"], None]


@dataclass
class Visit:
    """One WebSocket connection."""

    socket: ServerConnection
    number: int  # number of the connection, from 0
    requests: list[Request] = field(default_factory=list)

    def request(self) -> Request:
        """Return the next request, without probes."""
        data = self.socket.recv()
        while bytes(data[:4]) == b"VLA?":  # type: ignore[arg-type]
            data = self.socket.recv()
        [request] = decode_requests(data, Budget(DEFAULT_LIMITS)).requests  # type: ignore[arg-type]
        assert isinstance(request, Request), request
        self.requests.append(request)
        return request

    def answer(self, request: Request, **more: Any) -> None:
        self.socket.send(answer(request, **more))

    def watch(self) -> None:
        """Receive messages without answering until the client leaves."""
        for _ in self.socket:
            pass

    def raw(self, data: bytes) -> None:
        """Send bytes that bypass the WebSocket protocol."""
        self.socket.socket.sendall(data)


def answer(request: Request, **more: Any) -> bytes:
    """Return a reply. The reply to an act has the action [7], unless `more` says otherwise."""
    what: dict[str, Any] = (
        {"act": Act(np.array([7.0], np.float32))} if request.op == "act" else {"info": {}}
    )
    return encode_replies([Reply(request_id=request.request_id, **what | more)])


@dataclass
class ScriptedServer:
    port: int = 0
    metadata: dict[str, Any] = field(
        default_factory=lambda: {"protocol": PROTOCOL_VERSION, "policy": "scripted"}
    )
    refuse: Response | None = None  # the response to each request, if set
    visits: list[Visit] = field(default_factory=list)
    # The header `authorization` of each request.
    keys: list[str | None] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


def document(status: int, content: dict[str, Any] | str, **headers: str) -> Response:
    """Return a response with JSON or plain text."""
    kind = "text/plain" if isinstance(content, str) else "application/problem+json"
    body = content.encode() if isinstance(content, str) else json.dumps(content).encode()
    more = {name.replace("_", "-"): value for name, value in headers.items()}
    named = {"content-type": kind, "content-length": str(len(body)), "connection": "close", **more}
    return Response(status, http.HTTPStatus(status).phrase, Headers(named), body)


@contextmanager
def scripted_server(script: Script) -> Iterator[ScriptedServer]:
    """Run `script` in a thread for each WebSocket. The end of a connection by the client is not an
    error.
    """
    server = ScriptedServer()

    def process_request(_: ServerConnection, request: HttpRequest) -> Response | None:
        server.keys.append(request.headers.get("authorization"))
        if server.refuse is not None:
            return server.refuse
        return document(200, server.metadata) if request.path == "/v1/metadata" else None

    def handle(socket: ServerConnection) -> None:
        visit = Visit(socket, len(server.visits))
        server.visits.append(visit)
        with suppress(ConnectionClosed, OSError):
            script(visit)

    with serve(
        handle,
        "127.0.0.1",
        0,
        process_request=process_request,
        compression=None,
        max_size=None,
        close_timeout=1,
    ) as listening:
        server.port = listening.socket.getsockname()[1]
        thread = threading.Thread(target=listening.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            listening.shutdown()
            for visit in server.visits:
                visit.socket.socket.close()
            thread.join()


pytestmark = pytest.mark.compiler

ROWS = 4
FRAMES = [
    entry for entry in json.loads((GOLDEN / "index.json").read_text()) if entry["kind"] != "probe"
]


class Watcher(Agent):
    """A policy that returns ROWS rows [value, row] with the observed values in `info`, and waits
    for its `gate` on request.
    """

    contract = Contract(action=ActionSpec(dim=2), chunk=ROWS, history=3)
    shared = ("gate",)

    def __init__(self) -> None:
        self.gate = threading.Event()

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.asked = {"instruction": instruction, **kwargs}
        self.seen = deque([obs.info.get("value")], maxlen=3)
        return {
            "first": obs.info.get("value"),
            "nothing": float("nan"),
            "some": np.arange(2, dtype=np.uint8),
        }

    def observe(self, obs: Obs) -> None:
        self.seen.append(obs.info.get("value"))

    def act(self, obs: Obs) -> Act:
        if obs.info.get("wait"):
            self.gate.wait(60)
        self.observe(obs)
        value = float(obs.info.get("value", 0))
        rows = np.array([[value, row] for row in range(ROWS)], np.float32)
        info = {
            "asked": self.asked,
            "seen": list(self.seen),
            "pixels": {
                name: image.reshape(-1, 3)[0].tolist() for name, image in obs.cameras.items()
            },
            "joints": np.asarray(obs.state.get("joints", [])).tolist(),
            "gripper": obs.gripper,
        }
        return Act(
            rows[0] if obs.info.get("one") else rows, done=bool(obs.info.get("done")), info=info
        )


@dataclass
class Replica:
    engine: Engine
    policy: Watcher
    own: OwnPortServer
    known: ChangingKeys
    port: int
    stream: dict[str, Any] | None  # the metadata of its own port

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@contextmanager
def replica(*, keyed: bool = False) -> Iterator[Replica]:
    """Run a replica with its own port and the server's port, without Ray."""
    known, policy = ChangingKeys(), Watcher()
    engine = Engine(policy)
    check_key = (lambda token: known.keys.check(token, "app")) if keyed else NoKey.OPEN
    own = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, check_key)
    own.open()
    engine.start()
    found = Replica(engine, policy, own, known, 0, asdict(own.address))

    def metadata() -> dict[str, Any]:
        stated = {
            "policy": "watcher",
            "version": "0",
            "protocol": PROTOCOL_VERSION,
            "contract": policy.contract.to_json(),
        }
        return stated if found.stream is None else stated | {"stream": found.stream}

    inside = build_http_app(engine, metadata, MessageLimits())
    with ExitStack() as stack:
        found.port = stack.enter_context(
            served(AccessMiddleware(inside, known.keys if keyed else None, "app"))
        )
        stack.callback(own.close)
        stack.callback(engine.close)
        stack.callback(policy.gate.set)
        yield found


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("cpp"))


@pytest.fixture(scope="module")
def shared_replica() -> Iterator[Replica]:
    with replica() as one:
        yield one


@pytest.fixture
def server(shared_replica: Replica) -> Replica:
    shared_replica.stream = asdict(shared_replica.own.address)
    shared_replica.policy.gate.clear()
    return shared_replica


def rgb(value: int) -> dict[str, Any]:
    return {"rgb": value, "height": 16, "width": 24}


def refused(client: CppClient, do: str = "act", **arguments: Any) -> CppError:
    with pytest.raises(CppError) as error:
        client.call(do, **arguments)
    return error.value


def test_it_carries_the_reference_of_a_recurrent_policy(programs: Path) -> None:
    inputs, wanted = reference()
    with policy_server(Raptor()) as port, CppClient(programs, f"http://127.0.0.1:{port}") as client:
        for sequence in range(2):
            rows = [
                {name: part.tolist() for name, part in observation(row).state.items()}
                for row in inputs[:, sequence]
            ]
            client.reset(state=rows[0])
            actions = [client.act(state=row)["values"] for row in rows]
            assert np.abs(np.array(actions) - wanted[:, sequence]).max() < TOLERANCE


# Frames


def plain(meaning: Any) -> Any:
    """Convert a meaning of the golden files into the driver's format."""
    if isinstance(meaning, list):
        return [plain(each) for each in meaning]
    if not isinstance(meaning, dict):
        return meaning
    match meaning.get("$"):
        case "array":
            return np.array(plain(meaning["values"]), object).reshape(meaning["shape"]).tolist()
        case "image" | "bytes":
            return {"bytes": list(base64.b64decode(meaning["base64"])), "subtype": None}
        case "float":
            return None  # nlohmann's writer prints NaN and infinity like this
        case _:
            return {key: plain(value) for key, value in meaning.items()}


def states(found: Any, meaning: Any) -> bool:
    """Return whether a value of a frame contains everything of a meaning. It may have further keys,
    and lack defaults.
    """
    if isinstance(meaning, dict) and isinstance(found, dict):
        return all(states(found.get(key), value) for key, value in meaning.items())
    if isinstance(meaning, list) and isinstance(found, list):
        return len(found) == len(meaning) and all(map(states, found, meaning))
    return bool(found == meaning or (found is None and meaning in ({}, None)))


@pytest.mark.parametrize("entry", FRAMES, ids=lambda entry: Path(entry["file"]).stem)
def test_golden_frames_are_read_with_their_meaning(
    entry: dict[str, Any], shared_driver: CppClient
) -> None:
    data = (GOLDEN / entry["file"]).read_bytes().hex()
    if entry["kind"] == "malformed":
        assert refused(shared_driver, "reply", data=data).code == "malformed"
        return
    frame = shared_driver.call("decode", data=data)
    assert frame["same"]
    meaning = json.loads((GOLDEN / entry["meaning"]).read_text())
    values = frame["values"]
    found = values.get("requests") or values.get("replies") or [values]
    assert states(found, plain(meaning)), (found, plain(meaning))
    if "error" in meaning[0]:
        error = refused(shared_driver, "reply", data=data)
        wanted = meaning[0]["error"]
        assert (error.code, error.detail, error.retry_after_s) == (
            wanted["code"], wanted["detail"], wanted.get("retry_after_s")
        )  # fmt: skip
    elif len(meaning) == 1 and "act" in meaning[0]:
        action = meaning[0]["act"]["action"]
        act = shared_driver.call("reply", data=data)
        assert act["values"] == action["values"]
        assert ([act["rows"], act["dim"]] if act["chunk"] else [act["dim"]]) == action["shape"]


def observed(meaning: dict[str, Any]) -> dict[str, Any]:
    """Convert an observation of the golden files into the driver's format."""
    cameras = {
        name: {
            "pixels": bytes(image["values"]).hex(),
            "height": image["shape"][0],
            "width": image["shape"][1],
        }
        for name, image in meaning["cameras"].items()
    }
    gripper = {} if meaning["gripper"] is None else {"gripper": meaning["gripper"]}
    state = {name: array["values"] for name, array in meaning["state"].items()}
    return {"cameras": cameras, "state": state, "info": meaning["info"], **gripper}


@pytest.mark.parametrize("name", ["reset", "reset_contract", "act", "act_shortest"])
def test_written_frames_mean_what_the_golden_ones_do(name: str, shared_driver: CppClient) -> None:
    [meaning] = json.loads((GOLDEN / "frames" / f"{name}.json").read_text())
    asked = meaning | {
        "obs": observed(meaning["obs"]),
        "history": [observed(each) for each in meaning.get("history", [])],
    }
    data = bytes.fromhex(shared_driver.call("request", **asked))
    [request] = read_requests(data, Budget(MessageLimits()))
    assert isinstance(request, Request)
    written = of_request(request)
    assert written == {key: value for key, value in meaning.items() if key in written}
    assert set(meaning) - set(written) <= {
        "session",
        "request_id",
        "priority",
        "step",
        "deadline_ms",
    }


@pytest.fixture(scope="module")
def shared_driver(programs: Path) -> Iterator[CppClient]:
    with CppClient(programs) as driver:
        yield driver


def test_garbage_is_refused_and_never_read_past_its_end(shared_driver: CppClient) -> None:
    random = np.random.default_rng(0)
    frames = [
        (GOLDEN / entry["file"]).read_bytes() for entry in FRAMES if entry["kind"] == "replies"
    ]
    for _ in range(150):
        data = bytearray(frames[random.integers(len(frames))])
        for _ in range(random.integers(1, 4)):
            data[random.integers(len(data))] = random.integers(256)
        with suppress(CppError):  # the driver still answers after any input
            shared_driver.call("reply", data=bytes(data[: random.integers(len(data) + 1)]).hex())
    deep = b'{"blobs":[],"info":' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    framed = b"VLA\x01" + struct.pack("<I", len(deep)) + deep
    assert refused(shared_driver, "reply", data=framed.hex()).code == "malformed"


def test_no_answer_fills_the_memory_of_a_robots_computer(programs: Path) -> None:
    with CppClient(programs) as driver:
        before = driver.peak_mb()
        for answer in ANSWERS.values():
            with suppress(CppError):
                driver.call("reply", data=answer.hex())
        assert driver.peak_mb() - before < ADDED_MB


# A real server


@pytest.mark.parametrize("way", ["own port", "server's port", "own port out of reach"])
def test_an_episode(way: str, server: Replica, programs: Path) -> None:
    if way != "own port":
        server.stream = (
            None if way == "server's port" else {"port": free_port(), "path": "/v1/stream/none"}
        )
    with CppClient(programs, server.url, jpeg_quality=0) as client:
        assert client.call("metadata")["policy"] == "watcher"
        assert refused(client).code == "not_reset"
        said = client.reset(info={"value": 1})
        assert said == {"first": 1, "nothing": None, "some": [0, 1]}
        for value in (2, 3):
            joints = [0.25 * value] * 7
            act = client.act(
                cameras={"front": rgb(9), "wrist": rgb(200)},
                state={"joints": joints},
                gripper=0.5,
                info={"value": value},
            )
            assert (act["values"], act["rows"], act["dim"]) == (
                [value, 0, value, 1, value, 2, value, 3],
                ROWS,
                2,
            )
            assert act["info"]["pixels"] == {"front": [9] * 3, "wrist": [200] * 3}
            assert (act["info"]["joints"], act["info"]["gripper"]) == (joints, 0.5)
            assert not act["resumed"]
        assert act["info"]["asked"] == {"instruction": "push the cube", "seed": 3}
        assert act["info"]["seen"] == [1, 2, 3]
        assert act["timing"]["batch_size"] == 1
        last = client.act(info={"value": 5, "one": True, "done": True})
        assert (last["chunk"], last["dim"], last["done"], last["values"]) == (
            False,
            2,
            True,
            [5, 0],
        )
        assert len(server.engine.sessions) == 1
        client.call("close")
        assert len(server.engine.sessions) == 0
        assert refused(client).code == "not_reset"


def test_images_are_jpeg_unless_they_are_files_already(server: Replica, programs: Path) -> None:
    file = encode_jpeg(np.full((8, 8, 3), 77, np.uint8), quality=95)
    with CppClient(programs, server.url) as client:
        client.reset()
        pixels = client.act(cameras={"front": rgb(200), "wrist": {"file": file.hex()}})["info"][
            "pixels"
        ]
        assert np.allclose([pixels["front"], pixels["wrist"]], [[200] * 3, [77] * 3], atol=2)
        sent = client.call("jpeg", obs={"cameras": {"front": rgb(200)}}, quality=90)
        assert sent.startswith("ffd8ff")


def test_errors_of_the_server_have_its_code(server: Replica, programs: Path) -> None:
    with CppClient(programs, server.url, contract={"action": {"dim": 9}}) as client:
        assert refused(client, "reset").code == "contract_mismatch"
    with CppClient(programs, server.url) as client:
        client.reset()
        assert refused(client, obs={"gripper": 1e300}).code == "invalid_observation"
        assert client.act(info={"value": 4})["values"][0] == 4  # the session continues
        assert (
            refused(client, obs={"cameras": {"front": {"rgb": 0, "height": 0, "width": 9}}}).code
            == "invalid_input"
        )
    with CppClient(programs, server.url, jpeg_quality=0) as client:
        client.reset()
        large = {"cameras": {"front": {"rgb": 0, "height": 3000, "width": 2000}}}
        assert refused(client, obs=large).code == "too_large"  # 18 MB, which are not sent
        assert client.act(info={"value": 4})["values"][0] == 4


def test_a_call_ends_at_its_time_and_the_next_one_goes_on(server: Replica, programs: Path) -> None:
    with CppClient(programs, server.url, timeout_s=2.0) as client:
        client.reset(info={"value": 0})
        begun = time.monotonic()
        assert refused(client, obs={"info": {"wait": True}}).code == "outcome_unknown"
        assert time.monotonic() - begun >= 1.7
        server.policy.gate.set()
        act = client.act(info={"value": 8})
        assert (act["values"][0], act["resumed"]) == (8, False)


def test_a_lost_session_begins_again_with_what_the_policy_looks_at(programs: Path) -> None:
    with replica() as server, CppClient(programs, server.url) as client:
        client.reset(info={"value": 1})
        for value in (2, 3, 4, 5):
            client.act(info={"value": value})
        server.own.close()
        server.stream = None
        act = client.act(info={"value": 6})
        assert act["resumed"]
        assert act["info"]["seen"] == [4, 5, 6]
        assert act["info"]["asked"] == {"instruction": "push the cube", "seed": 3}
        assert not client.act(info={"value": 7})["resumed"]


def test_keys(programs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    monkeypatch.setattr(access_middleware, "_TICK_S", 0.02)
    monkeypatch.setattr(periodic.each_half_second, "_period_s", 0.02)
    with replica(keyed=True) as server:
        for key in ("", "vlr_wrong"):
            with CppClient(programs, server.url, key=key) as client:
                assert refused(client, "reset").code == "unauthorized"
        with CppClient(programs, server.url, key=server.known.add("arm")) as client:
            client.reset()
            assert client.act(info={"value": 2})["values"][0] == 2
            server.known.change("arm", revoked=True)
            # The server has noticed the end of its connection.
            wait_for(lambda: not server.engine.sessions)
            assert refused(client).code == "unauthorized"


def test_a_player_asks_for_the_next_chunk_in_time(server: Replica, programs: Path) -> None:
    with CppClient(programs, server.url, ahead=2) as player:
        player.reset()
        commands = [player.act(info={"value": tick}) for tick in range(10)]
    # The next chunk is requested with two rows left. These two rows replace its first two rows,
    # which are skipped.
    assert [command["action"] for command in commands] == [
        [0, 0], [0, 1], [0, 2], [0, 3], [2, 2], [2, 3], [4, 2], [4, 3], [6, 2], [6, 3],
    ]  # fmt: skip
    with CppClient(programs, server.url, ahead=0, execute=3) as player:
        player.reset()
        rows = [player.act(info={"value": tick})["action"] for tick in range(5)]
    assert rows == [[0, 0], [0, 1], [0, 2], [3, 0], [3, 1]]


def test_a_player_holds_while_a_chunk_is_late_and_leaves_out_no_row_for_it(
    server: Replica, programs: Path
) -> None:
    with CppClient(programs, server.url, ahead=1) as player:
        player.reset()
        obs = {"info": {"wait": True, "value": 5}}
        assert [player.call("act", obs=obs, wait=False) for _ in range(3)] == [None] * 3
        assert player.call("ticks") == {"ticks": 3, "starved": 3, "share": 0.0}
        server.policy.gate.set()
        commands = []
        while len(commands) < ROWS:
            if command := player.call("act", obs={"info": {"done": True}}, wait=False):
                commands.append(command["action"])
        assert commands == [[5, 0], [5, 1], [5, 2], [5, 3]]


def test_a_player_reports_its_ticks_to_the_server(server: Replica, programs: Path) -> None:
    with CppClient(programs, server.url, ahead=0) as player:
        player.reset()
        assert player.call("ticks") == {"ticks": 0, "starved": 0, "share": None}
        for _ in range(ROWS):
            player.act()
        player.call("missed", ticks=ROWS)
        player.act()  # this call requests the next chunk
        starved = {"ticks": 2 * ROWS + 1, "starved": ROWS, "share": (ROWS + 1) / (2 * ROWS + 1)}
        assert player.call("ticks") == pytest.approx(starved)

        times = server.engine.sessions.all()[-1].times
        assert times is not None
        lately = times.lately(server.engine.clock())
        assert (lately.ticks, lately.starved) == (2 * ROWS, ROWS)
        assert (lately.age_p50_ms or 0.0) > 0.0
        player.reset()
        assert player.call("ticks")["ticks"] == 0


def test_a_player_throws_once_the_rows_are_executed(programs: Path) -> None:
    with replica() as server, CppClient(programs, server.url, ahead=2, resume=False) as player:
        player.reset()
        assert player.act()["row"] == 0
        assert player.act()["row"] == 1
        server.own.close()
        assert player.act()["row"] == 2  # this call also requests the next chunk
        assert player.act()["row"] == 3
        assert refused(player).code == "connection_lost"


def test_the_example_drives_a_robot(server: Replica, programs: Path) -> None:
    done = subprocess.run(
        [programs / "loop", server.url, "0.5"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "of 2 numbers" in done.stdout
    assert done.stderr == ""


# Servers that violate the protocol


def obedient(visit: Visit) -> None:
    while True:
        visit.answer(visit.request())


def test_nobody_is_there(programs: Path) -> None:
    with CppClient(programs, f"http://127.0.0.1:{free_port()}") as client:
        assert refused(client, "reset").code == "unavailable"
    for url in (
        "https://127.0.0.1:1",
        "ftp://127.0.0.1",
        "http://",
        "http://127.0.0.1:port",
        "http://a b:1",
    ):
        with CppClient(programs) as client:
            assert refused(client, "connect", url=url).code == "invalid_input"


@pytest.mark.parametrize(
    ("response", "code", "retry_after_s"),
    [
        (
            document(503, {"code": "no_replica", "detail": "it loads"}, retry_after="2"),
            "no_replica",
            2.0,
        ),
        (document(503, "no replica"), "unavailable", None),
        (document(401, {"code": "unauthorized", "detail": "a key"}), "unauthorized", None),
        (document(429, "slow down", retry_after="0.5"), "too_many_requests", 0.5),
        (document(500, "[" * 100_000), "internal", None),
        (document(200, "no JSON"), "malformed", None),
        (document(200, {"protocol": 2}), "malformed", None),
    ],
    ids=["503", "503 in text", "401", "429", "500", "no metadata", "version 2"],
)
def test_a_refusal_is_an_error_with_its_code(
    response: Any, code: str, retry_after_s: float | None, programs: Path
) -> None:
    with (
        scripted_server(obedient) as server,
        CppClient(programs, server.url, key="vlr_a") as client,
    ):
        server.refuse = response
        error = refused(client, "reset")
        assert (error.code, error.retry_after_s) == (code, retry_after_s)
        server.refuse = None
        client.reset()
        assert client.act()["values"] == [7]
        assert set(server.keys) == {"Bearer vlr_a"}


def _header(length: int, first: int = 0x82) -> bytes:
    return bytes([first, 127]) + struct.pack(">Q", length)


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (_header(2**40), "too_large"),
        (_header(100) + b"VLA\x01", "outcome_unknown"),  # no further bytes
        (b"\x82\x84\0\0\0\0VLA\x01", "malformed"),  # masked
        (b"\xc2\x04VLA\x01", "malformed"),  # compressed
        (b"\x81\x04text", "malformed"),
        (b"\x80\x04VLA\x01", "malformed"),  # a continuation without a message
        (b"\x89\x7e\x01\x00" + bytes(256), "malformed"),  # a ping that is too long
        (b"\x82\x05abcde", "malformed"),
        (b"\x88\x02\x03\xf0", "connection_lost"),  # closed with 1008
    ],
    ids=[
        "oversized",
        "half",
        "masked",
        "compressed",
        "text",
        "continuation",
        "ping",
        "no frame",
        "closed",
    ],
)
def test_a_wrong_message_is_an_error_and_the_next_call_begins_again(
    sent: bytes, code: str, programs: Path
) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        request = visit.request()
        if visit.number == 0:
            visit.raw(sent)
            visit.watch()
        visit.answer(request)

    with (
        scripted_server(script) as server,
        CppClient(programs, server.url, timeout_s=2.0, resume=False) as client,
    ):
        client.reset()
        assert refused(client).code == code
        client.reset()
        assert client.act()["values"] == [7]


def test_pings_fragments_and_replies_of_nobody_are_read(programs: Path) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        request = visit.request()
        visit.socket.ping().wait(10)
        visit.socket.send(answer(Request("act", request_id="of nobody")))
        data = answer(request)
        visit.socket.send([data[:5], data[5:9], data[9:]])
        pong = visit.socket.ping()  # also while no call waits
        assert pong.wait(10)
        visit.answer(visit.request())

    with scripted_server(script) as server, CppClient(programs, server.url) as client:
        client.reset()
        assert client.act()["values"] == [7]
        assert client.act()["values"] == [7]


def test_a_draining_replica_is_left_with_session_and_step(programs: Path) -> None:
    ended = threading.Event()

    def script(visit: Visit) -> None:
        if visit.number == 0:
            visit.answer(visit.request(), step=2**62 + 1)
            visit.answer(visit.request(), step=2**62 + 2, draining=True)
            visit.watch()
            ended.set()
            return
        while True:
            visit.answer(visit.request(), step=2**62 + 3)

    with scripted_server(script) as server, CppClient(programs, server.url) as client:
        client.reset()
        assert client.act()["resumed"] is False
        assert client.act()["resumed"] is False
        assert ended.wait(20)
        before, after = server.visits
        assert [request.op for request in after.requests] == ["act"]
        assert after.requests[0].session == before.requests[0].session != ""
        assert [request.step for request in before.requests + after.requests] == [
            None,
            2**62 + 1,
            2**62 + 2,
        ]


def test_a_silent_replica_is_left_at_the_next_call(programs: Path) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        if visit.number == 0:
            visit.request()
            visit.watch()
        obedient(visit)

    with (
        scripted_server(script) as server,
        CppClient(programs, server.url, timeout_s=2.0) as client,
    ):
        client.reset()
        assert refused(client).code == "outcome_unknown"
        assert client.act()["resumed"]
        assert [request.op for request in server.visits[1].requests] == ["reset", "act"]
        assert server.visits[1].requests[0].session != server.visits[0].requests[0].session


def test_a_lost_session_waits_for_a_server_that_comes_back(programs: Path) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        if visit.number == 0:
            visit.request()
            server.refuse = document(
                503, {"code": "no_replica", "detail": "it loads"}, retry_after="0.2"
            )
            visit.socket.close()
            return
        obedient(visit)

    with scripted_server(script) as server, CppClient(programs, server.url) as client:
        client.reset(info={"value": 1})
        client.begin("act", obs={"info": {"value": 2}})
        while len(server.keys) < 4:  # metadata and WebSocket, then at least two rejections
            time.sleep(0.01)
        server.refuse = None
        assert client.result()["resumed"]
        assert server.visits[1].requests[0].obs.info == {"value": 1}  # type: ignore[union-attr]
    with (
        scripted_server(script) as server,
        CppClient(programs, server.url, timeout_s=2.0) as client,
    ):
        client.reset()
        assert refused(client).code == "no_replica"


def test_an_error_of_a_full_server_is_not_retried(programs: Path) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        request = visit.request()
        visit.answer(request, act=None, error=Overloaded("full"))
        obedient(visit)

    with scripted_server(script) as server, CppClient(programs, server.url) as client:
        client.reset()
        error = refused(client)
        assert (error.code, error.retry_after_s) == ("overloaded", 1.0)
        assert client.act()["values"] == [7]
        assert [request.op for request in server.visits[0].requests] == ["reset", "act", "act"]


@pytest.mark.parametrize("action", [[np.nan], [np.inf, 0.0]], ids=["nan", "inf"])
def test_no_robot_gets_an_action_that_is_no_number(action: list[float], programs: Path) -> None:
    def script(visit: Visit) -> None:
        visit.answer(visit.request())
        visit.answer(visit.request(), act=Act(np.array(action, np.float32)))

    with scripted_server(script) as server, CppClient(programs, server.url) as client:
        client.reset()
        assert refused(client).code == "invalid_action"
