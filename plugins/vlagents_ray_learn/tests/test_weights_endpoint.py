"""Pushes of learners on other machines: one connection is one push, by a key with the scope for
it.
"""

from __future__ import annotations

import json
import runpy
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from readme_blocks import DOCS, blocks, run
from websockets.exceptions import ConnectionClosed

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.websocket import ProxiedSocket, open_websocket
from vlagents_ray.errors import (
    Forbidden,
    InvalidInput,
    InvalidWeights,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    Unauthorized,
    UnchangedWeights,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent, Obs, TrainableAgent
from vlagents_ray.protocol.frames import read_error
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, MessageLimits
from vlagents_ray.serve import weights as versions
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.config.parts import PartConfig
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.asgi_websocket import AsgiWebSockets
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.replica.part import PartContext
from vlagents_ray.weights.safetensors import (
    MESSAGE_BYTES,
    PART_BYTES,
    header_of,
    parts_of,
    read_header,
)
from vlagents_ray_learn import Publisher, publisher
from vlagents_ray_learn import weights_endpoint as endpoint
from vlagents_ray_learn.weights_part import WeightsPart

LENGTH = 3 * 2**20  # 12 MiB, so that there are several parts


class Gain(TrainableAgent):
    trainable: ClassVar[str | None] = "tree"

    def initialize(self) -> None:
        self.tree = {"gain": np.zeros(LENGTH, np.float32), "offset": np.zeros(2, np.float32)}

    def act(self, obs: Obs) -> Act:
        return Act(self.tree["offset"])


Serving = Callable[..., SimpleNamespace]


@pytest.fixture
def serving(monkeypatch: pytest.MonkeyPatch) -> Iterator[Serving]:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    opened: list[Any] = []

    def open_one(
        agent: Agent | None = None,
        keys: Keys | None = None,
        slow_s: float = 30.0,
        *,
        insecure: bool = False,
    ) -> SimpleNamespace:
        engine = Engine(agent or Gain())
        engine.start()
        context = PartContext(engine, "this", "here", dict, slow_s=slow_s, open_to_network=insecure)
        part = WeightsPart(PartConfig(), context)
        about = {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION}
        inside = build_http_app(engine, lambda: about, MessageLimits(), more=part.routes())
        server = served(AccessMiddleware(inside, keys, "app"))
        opened.extend((server, engine))
        return SimpleNamespace(url=f"http://127.0.0.1:{server.__enter__()}", engine=engine)

    yield open_one
    for server, engine in zip(opened[::2], opened[1::2], strict=True):
        server.__exit__(None, None, None)
        engine.close()


def gains(value: float) -> dict[str, np.ndarray]:
    return {"gain": np.full(LENGTH, value, np.float32), "offset": np.full(2, value, np.float32)}


def opened(server: SimpleNamespace, query: str = "", key: str = "") -> closing[ProxiedSocket]:
    url = server.url.replace("http", "ws") + f"/v1/weights{query}"
    return closing(open_websocket(url, Credentials(key), 10))


def answer(socket: ProxiedSocket, part: bytes) -> dict[str, Any]:
    with suppress(ConnectionClosed, OSError):  # rejected already
        socket.send(part, 10)
    found: dict[str, Any] = json.loads(socket.recv(30))
    return found


def test_a_learner_elsewhere_pushes_and_asks_which_replicas_act_with_it(serving: Serving) -> None:
    server = serving()
    with Publisher(server.url) as weights:
        assert weights.push(gains(1)) == 1
        assert weights.push({"offset": np.ones(2)}, partial=True, mode="keep", allow_same=True) == 2
        assert (weights.acknowledged(1), weights.acknowledged(2), weights.acknowledged(3)) == (
            1,
            1,
            0,
        )
        assert weights.push(gains(1), version=500, allow_same=True) == 500
    held = server.engine.model.own_weights._trainable.tree
    assert server.engine.weights.describe()["newest"]["version"] == 500
    assert held["offset"].tolist() == [0, 0]  # no session has begun since
    newest = server.engine.model.own_weights.newest.values
    assert (newest["gain"][0], newest["gain"][-1], newest["offset"][0]) == (1, 1, 1)


def test_the_first_example_of_the_page_prints_what_it_shows(
    serving: Serving, tmp_path: Path
) -> None:
    page = blocks((DOCS / "weights.md").read_text())
    [example] = [block for block in page if "RemoteAgent(" in block.source]
    [definition] = [block for block in page if "class Reach(" in block.source]
    (tmp_path / "reach.py").write_text(definition.source)
    server = serving(runpy.run_path(str(tmp_path / "reach.py"))["Reach"]())
    host = server.url.removeprefix("http://")
    run(replace(example, server="reach:Reach", not_run=None), tmp_path, host, page="weights")


def test_values_that_are_received_are_not_copied_again(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serving()
    received: list[Mapping[str, Any]] = []
    own = server.engine.model.own_weights
    stage = own.stage
    monkeypatch.setattr(
        own, "stage", lambda *args, **how: (received.append(args[1]), stage(*args, **how))[1]
    )
    Publisher(server.url).push(gains(1))
    assert np.shares_memory(own.newest.values["gain"], received[0]["gain"])


def test_what_does_not_fit_is_refused_before_it_is_sent(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serving()
    weights = Publisher(server.url)
    sent: list[int] = []
    send = ProxiedSocket.send
    monkeypatch.setattr(
        ProxiedSocket, "send", lambda self, part, s: (sent.append(len(part)), send(self, part, s))
    )
    for wrong, says in (
        (gains(1) | {"other": np.zeros(2**24, np.int8)}, "'other': expected one of the policy's"),
        ({"gain": gains(1)["gain"]}, "'offset': missing"),
        (gains(1) | {"gain": np.zeros((2, LENGTH), np.float32)}, "'gain': expected shape"),
    ):
        sent.clear()
        with pytest.raises(InvalidWeights, match=says):
            weights.push(wrong)
        assert sum(sent) < 1000
    # After it was.
    for wrong, error in ((gains(np.nan), InvalidWeights), (gains(0), UnchangedWeights)):
        with pytest.raises(error):
            weights.push(wrong)
    assert server.engine.weights.number == 0


def test_keys_need_the_scope(serving: Serving) -> None:
    known = ChangingKeys()
    server = serving(keys=known.keys)
    learner, robot = known.add("learner", scopes=["weights"]), known.add("robot")
    assert Publisher(server.url, api_key=learner).push(gains(1)) == 1
    for key, error in ((robot, Forbidden), ("", Unauthorized), ("vlr_wrong", Unauthorized)):
        weights = Publisher(server.url, api_key=key)
        for ask in (
            lambda weights=weights: weights.push(gains(2)),
            lambda weights=weights: weights.acknowledged(1),
        ):
            with pytest.raises(error):
                ask()
    known.change("learner", rate=1e-6)
    known.keys.check(learner, "app").take_request()
    with pytest.raises(TooManyRequests):
        Publisher(server.url, api_key=learner).push(gains(2))
    assert server.engine.weights.number == 1


def test_a_learner_elsewhere_lets_the_policy_rest_with_the_scope_for_pushes(
    serving: Serving,
) -> None:
    known = ChangingKeys()
    server = serving(keys=known.keys)
    robot, key = known.add("robot"), known.add("learner", scopes=["weights"])
    for refused in (lambda one: one.sleep(), lambda one: one.wake()):
        with pytest.raises(Forbidden):
            refused(Publisher(server.url, api_key=robot))
    learner = Publisher(server.url, api_key=key)
    learner.sleep(offload=False, at_most_s=60)
    with pytest.raises(Overloaded, match="already asleep"):
        learner.sleep()
    assert learner.wake(gains(1)) == 1
    with pytest.raises(Forbidden):
        Publisher(serving(insecure=True).url).sleep()
    with closing(HttpTransport(server.url, CodecChoice("raw"), Credentials(key))) as http:
        for path in (
            "nap",
            "sleep?offload=maybe",
            "sleep?at_most_s=nan",
            "sleep?at_most_s=1e99",
            "wake?level=2",
        ):
            with pytest.raises(InvalidInput):
                http.get(f"/v1/weights/{path}", 10, method="POST")


@pytest.mark.parametrize(
    ("change", "error"), [({"revoked": True}, Unauthorized), ({"scopes": []}, Forbidden)]
)
def test_a_key_that_loses_its_right_ends_the_push(
    serving: Serving, change: Any, error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The periodic check would sometimes close the connection first.
    monkeypatch.setattr(AsgiWebSockets, "close_overdue", lambda _: None)
    known = ChangingKeys()
    server = serving(keys=known.keys)
    key, values = known.add("learner", scopes=["weights"]), gains(1)
    first, second, *_ = parts_of(values)
    with opened(server, key=key) as socket:
        assert answer(socket, header_of(values)) == {"received": 0}
        assert answer(socket, first) == {"received": PART_BYTES}
        known.change("learner", **change)
        assert isinstance(read_error(answer(socket, second)), error)
    assert server.engine.weights.number == 0


def test_several_parts_are_on_their_way_at_once_but_none_before_the_header_is_accepted(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, steps = serving(), list[str]()
    send, recv = ProxiedSocket.send, ProxiedSocket.recv
    monkeypatch.setattr(
        ProxiedSocket, "send", lambda self, *of: (steps.append("s"), send(self, *of))[1]
    )
    monkeypatch.setattr(
        ProxiedSocket, "recv", lambda self, *of: (steps.append("r"), recv(self, *of))[1]
    )
    monkeypatch.setattr(publisher, "_WINDOW", 4)
    Publisher(server.url).push(gains(1))  # a header and 13 parts
    assert "".join(steps) == "sr" + "sss" + "sr" * 10 + "rrr"


@pytest.mark.parametrize("closed", [False, True], ids=["answered", "closed"])
def test_a_push_that_is_refused_with_parts_on_their_way_says_why(
    serving: Serving, closed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next part finds out that the key was revoked, or the periodic check does."""
    known = ChangingKeys()
    server = serving(keys=known.keys)
    key, send, sent = known.add("learner", scopes=["weights"]), ProxiedSocket.send, list[int]()

    def change_before_the_third(self: ProxiedSocket, part: Any, timeout_s: float) -> None:
        sent.append(len(part))
        if len(sent) == 3:
            if closed:
                self.recv(30)  # the answer to the first part, which must not find out
            known.change("learner", revoked=True)
            if closed:
                with pytest.raises(ConnectionClosed, match="1008"):
                    self.recv(30)
        send(self, part, timeout_s)

    if not closed:
        monkeypatch.setattr(AsgiWebSockets, "close_overdue", lambda _: None)
    monkeypatch.setattr(ProxiedSocket, "send", change_before_the_third)
    with pytest.raises(Unauthorized):
        Publisher(server.url, api_key=key).push(gains(1))
    assert server.engine.weights.number == 0


def test_a_server_that_is_open_to_the_network_without_keys_takes_none(serving: Serving) -> None:
    server = serving(insecure=True)
    with pytest.raises(Forbidden, match="--scope weights"):
        Publisher(server.url).push(gains(1))
    with pytest.raises(Forbidden):
        Publisher(server.url).acknowledged(0)


def test_a_push_that_dies_half_way_leaves_nothing_behind(serving: Serving) -> None:
    server = serving()
    values = gains(1)
    with opened(server) as socket:
        answer(socket, header_of(values))
        answer(socket, next(parts_of(values)))
        with pytest.raises(Overloaded, match="another push is in progress here"):
            Publisher(server.url).push(gains(2))
    weights = Publisher(server.url)

    def pushed() -> bool:
        try:
            return weights.push(gains(3)) == 1
        except Overloaded:  # the server has not seen the end yet
            return False

    wait_for(pushed)
    assert server.engine.model.own_weights._staged is None


def test_a_learner_that_is_silent_is_not_waited_for(serving: Serving) -> None:
    server, header = serving(slow_s=0.2), header_of(gains(1))
    for _ in range(20):
        with opened(server) as socket:
            # Else this machine was too slow for the header.
            if answer(socket, header) == {"received": 0}:
                refused = read_error(json.loads(socket.recv(30)))
                break
    assert isinstance(refused, MalformedMessage)
    assert "no part within 0.2 s" in str(refused)
    server = serving()
    assert Publisher(server.url).push(gains(1)) == 1


def test_a_push_that_sends_too_little_does_not_hold_up_others(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, values = serving(), gains(1)
    monkeypatch.setattr(endpoint, "LEAST_RATE", 2**40)
    # 20 s a call.
    monkeypatch.setattr(
        endpoint, "time", SimpleNamespace(monotonic=iter(range(0, 1000, 20)).__next__)
    )
    with opened(server) as socket:
        assert answer(socket, header_of(values)) == {"received": 0}
        parts = parts_of(values)
        found = [answer(socket, next(parts)) for _ in range(2)]
        assert "expected at least" in str(read_error(found[-1]))
    wait_for(lambda: _is_free(server))


def _is_free(server: SimpleNamespace) -> bool:
    with opened(server) as socket:
        return answer(socket, header_of(gains(1))) == {"received": 0}


def test_a_header_beyond_the_policys_own_names_is_not_parsed(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[bytes] = []
    monkeypatch.setattr(
        versions, "read_header", lambda data: (parsed.append(data), read_header(data))[1]
    )
    many = header_of({f"name {number}": np.zeros(1, np.float32) for number in range(200)})
    with opened(serving()) as socket:
        assert isinstance(read_error(answer(socket, many)), MessageTooLarge)
    assert not parsed


def test_garbage_is_refused_with_its_reason(serving: Serving) -> None:
    wrong: list[tuple[str, list[Any], type[Exception]]] = [
        ("?mode=abort", [], InvalidInput),
        ("?partial=yes", [], InvalidInput),
        ("?pickle=true", [], InvalidInput),
        ("?version=true", [], InvalidInput),
        ("?version=0", [], InvalidInput),
        ("?version=-1", [], InvalidInput),
        ("?version=9" + "9" * 5000, [], InvalidInput),
        ("", [b"garbage"], MalformedMessage),
        ("", [b""], MalformedMessage),
        ("?partial=true", [header_of({"offset": np.zeros(2, np.float32)}), b""], MalformedMessage),
        ("", [b"\0" * (MESSAGE_BYTES + 1)], MessageTooLarge),
        (
            "?partial=true",
            [header_of({"offset": np.zeros(2, np.float32)}), b"\0" * 9],
            MalformedMessage,
        ),
        ("", ["text"], MalformedMessage),
    ]
    server = serving()
    for query, parts, error in wrong:

        def found(query: str = query, parts: list[Any] = parts) -> type:
            with opened(server, query) as socket:
                return type(
                    read_error([answer(socket, part) for part in parts or [b"garbage"]][-1])
                )

        # One push at a time: the last may not have ended.
        wait_for(lambda error=error, found=found: found() is error)
    assert server.engine.weights.number == 0


def test_an_error_of_the_server_itself_is_not_shown(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serving()

    def fail(*args: Any, **how: Any) -> str:
        raise RuntimeError("secret")

    monkeypatch.setattr(server.engine.model.own_weights, "stage", fail)
    with pytest.raises(VLAgentsError, match="internal error"):
        Publisher(server.url).push(gains(1))


def test_a_push_whose_learner_leaves_after_the_last_part_is_completed(
    serving: Serving, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = serving()
    begun, may_go_on = threading.Event(), threading.Event()
    own = server.engine.model.own_weights
    stage = own.stage
    monkeypatch.setattr(
        own, "stage", lambda *args, **how: (begun.set(), may_go_on.wait(30), stage(*args, **how))[2]
    )
    values = {"offset": np.ones(2, np.float32)}
    with opened(server, "?partial=true") as socket:
        answer(socket, header_of(values))
        socket.send(next(parts_of(values)), 10)
        assert begun.wait(30)
    may_go_on.set()
    wait_for(lambda: server.engine.weights.number == 1)


def test_a_server_that_is_not_there_is_named() -> None:
    with pytest.raises(PolicyUnavailable, match="cannot connect"):
        Publisher("http://127.0.0.1:9").push(gains(1))
