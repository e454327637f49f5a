"""Tests of the live page's data: the permissions of viewers, and that the data equal the policy's
inputs and answers.
"""

from __future__ import annotations

import json
import re
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from live_server import LiveServer, ask, live_server, read_message
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import open_websocket
from vlagents_ray.errors import (
    ConfigError,
    Forbidden,
    PolicyUnavailable,
    Unauthorized,
    VLAgentsError,
)
from vlagents_ray.images.codecs import JPEG
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.frames import read_error
from vlagents_ray.serve.access import api_keys
from vlagents_ray_live import live_page
from vlagents_ray_live.live_page import page_server
from vlagents_ray_live.live_view import Fleet

RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 255, (16, 24, 3), np.uint8)


class Explains(Agent):
    """Answers with a chunk and further info."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        return {}

    def act(self, obs: Obs) -> Act:
        if obs.info.get("fail"):
            raise RuntimeError("secret")
        said = {
            "subtask": "grasp",
            "uncertainty": np.float32(0.25),
            "nothing": float("nan"),
            "map": np.zeros((9, 9)),
        }
        return Act(np.arange(6, dtype=np.float32).reshape(3, 2), info=said)


@pytest.fixture(scope="module")
def server() -> Iterator[LiveServer]:
    with live_server(Explains()) as one:
        yield one


def get(url: str, headers: Mapping[str, str] = {}) -> tuple[int, bytes, Mapping[str, str]]:
    try:
        with urllib.request.urlopen(
            urllib.request.Request(url, headers=dict(headers)), timeout=10
        ) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as refused:
        return refused.code, refused.read(), dict(refused.headers)


@pytest.mark.parametrize("codec", ["jpeg", "raw"])
def test_a_viewer_sees_what_the_policy_got_and_answered(server: LiveServer, codec: str) -> None:
    with server.viewer() as viewer, RemoteAgent(server.url, codec=codec) as agent:
        ask(viewer)
        session, obs = None, Obs({"front": IMAGE}, 0.5, {"joints": np.arange(3, dtype=np.float32)})
        agent.reset(obs, "stack the cubes")
        found: dict[str, object] = {}
        while "act" not in found or "picture" not in found:
            agent.act(obs)
            document, files = ask(viewer, [] if session is None else [session])
            # A slow viewer gets several documents of the same replica.
            replica = document["replicas"][-1]
            for one in [one for each in document["replicas"] for one in each["sessions"]]:
                session = one["id"]
                assert one["instruction"] == "stack the cubes"
                if one.get("last", {}).get("op") == "act":
                    found["act"] = one["last"]
                if one["pictures"]:
                    found["picture"], found["state"] = files[one["pictures"]["front"]], one["state"]
        act = found["act"]
        assert isinstance(act, dict)
        assert act["action"] == [[0, 1], [2, 3], [4, 5]]
        assert act["info"] == {"subtask": "grasp", "uncertainty": 0.25, "nothing": None}
        assert set(act["ms"]) >= {"decode_ms", "queue_ms", "inference_ms", "total_ms"}
        assert found["state"] == {"joints": [0, 1, 2], "gripper": [0.5]}
        # The same file, whether the client sent it or it was encoded from the pixels.
        sent = JPEG.file(IMAGE)
        assert found["picture"] == sent
        assert np.abs(decode(sent, 10**6).astype(int) - IMAGE).mean() < 60
        assert (replica["name"], replica["policy"], replica["ready"]) == ("this", "noop", True)
        assert replica["weights"]["newest"]["version"] == 3


def test_errors_and_sessions_that_ended_are_told(server: LiveServer) -> None:
    with server.viewer() as viewer:
        ask(viewer)
        with RemoteAgent(server.url) as agent:
            agent.reset(Obs(), "")
            with pytest.raises(VLAgentsError):
                agent.act(Obs(info={"fail": True}))
            failing = server.engine.sessions.ids()
            told: dict[str, int] = {}
            failed: list[str] = []
            while not told or not failed:
                for replica in ask(viewer)[0]["replicas"]:
                    told |= replica["errors"]
                    failed += [
                        one["last"]["detail"]
                        for one in replica["sessions"]
                        if "error" in one.get("last", {})
                    ]
            assert told == {"policy_failed": 1}
            assert "secret" not in failed[0]
        wait_for(lambda: not ask(viewer)[0]["replicas"][-1]["sessions"])
        assert all(server.view.live.observation(session) is None for session in failing)


@pytest.mark.slow
def test_nothing_is_kept_once_nobody_looks(server: LiveServer) -> None:
    with server.viewer() as viewer:
        ask(viewer)
        assert server.engine.observers.any
        # The data are also available without a WebSocket.
        status, text, _ = get(f"{server.url}/v1/live", {"sec-fetch-site": "same-origin"})
        assert (status, json.loads(text)["replicas"][0]["waiting"]) == (
            200,
            {"robot": 0, "simulation": 0},
        )
    wait_for(lambda: server.engine.observers.any is False)


def test_the_page_holds_no_data_and_no_addresses(server: LiveServer) -> None:
    status, text, _ = get(f"{server.url}/live")
    assert status == 200
    assert b"org/model" not in text
    assert b"http:" not in text.replace(b"http://www.w3.org/2000/svg", b"")
    assert b"https:" not in text.replace(b'"https:"', b"")


def test_the_scripts_of_the_page_share_no_name_since_they_share_one_scope() -> None:
    html, *_ = live_page.live_page()
    names = re.findall(r"^(?:const|let|class|(?:async )?function) (\w+)", html, re.MULTILINE)
    assert {"showEvaluation", "showFleet"} < set(names)
    assert {name for name in names if names.count(name) > 1} == set()


@pytest.mark.parametrize(
    "message", [b"", b"[]", b'{"shown": [1]}', b'{"shown": 3}', b"{", b"[" * 10_000]
)
def test_a_malformed_question_ends_that_viewer_alone(server: LiveServer, message: bytes) -> None:
    with server.viewer() as viewer, server.viewer() as other:
        viewer.send(message, 10)
        assert json.loads(viewer.recv(10))["code"] == "malformed"
        assert ask(other)[0]["replicas"]


def test_more_viewers_than_allowed_are_refused(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "_VIEWERS", 1)
    with server.viewer() as viewer:
        ask(viewer)
        with pytest.raises(PolicyUnavailable), server.viewer():
            pass


def test_a_viewer_who_asks_for_nothing_is_let_go(
    server: LiveServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_page, "_SILENT_S", 0.1)
    with server.viewer() as viewer:
        assert "within 0.1 s" in json.loads(viewer.recv(10))["detail"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        # The browser requests the address as an image, without an origin.
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"},
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
        {"sec-fetch-site": "same-site"},  # the request is from another port of this machine
    ],
)
def test_another_sites_page_sees_nothing_and_does_not_start_the_observer(
    server: LiveServer, headers: dict[str, str]
) -> None:
    wait_for(lambda: server.engine.observers.any is False)
    assert get(f"{server.url}/v1/live", headers)[0] == 403
    assert server.engine.observers.any is False
    assert not server.fleet.viewers


def test_a_server_open_to_the_network_shows_nothing() -> None:
    with live_server(insecure=True) as server:
        status, text, _ = get(f"{server.url}/v1/live")
        assert status == 403
        assert "--scope watch" in json.loads(text)["detail"]
        with pytest.raises(Forbidden), server.viewer():
            pass


@pytest.fixture
def keys(monkeypatch: pytest.MonkeyPatch) -> ChangingKeys:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    return ChangingKeys()


def test_a_key_wants_the_scope(keys: ChangingKeys) -> None:
    plain, watching = keys.add("plain"), keys.add("watching", scopes=["watch"])
    with live_server(keys=keys.keys) as server:
        with pytest.raises(Unauthorized), server.viewer():
            pass
        with pytest.raises(Forbidden), server.viewer(plain):
            pass
        with server.viewer(watching) as viewer:
            ask(viewer)
            keys.change("watching", scopes=[])
            viewer.send(b'{"shown": []}', 10)
            while True:
                said = viewer.recv(10)
                if not said.startswith(b"{"):
                    read_message(said)  # the message had already been sent
                    viewer.send(b'{"shown": []}', 10)
                    continue
                assert isinstance(read_error(json.loads(said)), Forbidden)
                break


def test_a_browser_states_its_key_as_a_subprotocol_that_is_not_sent_back(
    keys: ChangingKeys,
) -> None:
    token = keys.add("watching", scopes=["watch"])
    with live_server(keys=keys.keys) as server:
        offered = ["vlagents.live", f"vlagents.key.{token}"]
        with connect(
            f"ws://127.0.0.1:{server.port}/v1/live", subprotocols=offered, proxy=None
        ) as stream:  # type: ignore[arg-type]
            assert stream.subprotocol == "vlagents.live"
            stream.send('{"shown": []}')
            message = stream.recv(10)
            assert isinstance(message, bytes)
            assert read_message(message)[0]["replicas"]


def test_viewers_end_with_the_server() -> None:
    ended = threading.Event()
    with live_server() as server:
        viewer = server.viewer()
        opened = viewer.__enter__()
        ask(opened)

        def watch() -> None:
            with suppress(ConnectionClosed, VLAgentsError, OSError):
                while True:
                    ask(opened)
            ended.set()

        threading.Thread(target=watch, daemon=True).start()
    assert ended.wait(30)


# The page of a process that is not a replica: its address, the permissions of viewers, and its end.


def fleet() -> Fleet:
    said = {"evaluation": {"done": 1}}
    return Fleet(None, extra=lambda: said)


def test_it_is_there_until_the_end_of_the_context() -> None:
    with page_server(fleet(), ("127.0.0.1", 0), None, name="eval", videos={}.get) as url:
        assert get(url)[0] == 200
        status, text, _ = get(url.replace("/live", "/v1/live"))
        assert (status, json.loads(text)["evaluation"]) == (200, {"done": 1})
        assert get(url.replace("/live", "/v1/live"), {"origin": "http://evil.example"})[0] == 403
    with pytest.raises(urllib.error.URLError):
        get(url)


@pytest.mark.slow
def test_a_viewer_does_not_keep_it_from_ending() -> None:
    with page_server(fleet(), ("127.0.0.1", 0), None, name="eval", videos={}.get) as url:
        viewer = open_websocket(
            url.replace("http", "ws").replace("/live", "/v1/live"), Credentials(""), 10
        )
    viewer.close()


def test_videos_are_files_by_number_for_those_who_may_watch(tmp_path: Path) -> None:
    keys = ChangingKeys()
    plain, watching = keys.add("plain"), keys.add("watching", scopes=["watch"])
    (tmp_path / "film.mp4").write_bytes(b"film")
    found = {3: tmp_path / "film.mp4"}
    with page_server(fleet(), ("127.0.0.1", 0), keys.keys, name="eval", videos=found.get) as url:
        videos = url.replace("/live", "/v1/live/videos")
        bearer = {"authorization": f"Bearer {watching}"}
        assert get(f"{videos}/3", bearer)[:2] == (200, b"film")
        assert get(f"{videos}/4", bearer)[0] == 404
        assert get(f"{videos}/..%2f3", bearer)[0] == 404
        assert get(f"{videos}/3")[0] == 401
        assert get(f"{videos}/3", {"authorization": f"Bearer {plain}"})[0] == 403


@pytest.mark.parametrize("host", ["::", "192.0.2.1", "gpu-box"])
def test_other_machines_need_a_key(host: str) -> None:
    with (
        pytest.raises(ConfigError, match="--scope watch"),
        page_server(fleet(), (host, 0), None, name="eval", videos={}.get),
    ):
        pass


def test_a_port_in_use_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = ("127.0.0.1", taken.getsockname()[1])
        with (
            pytest.raises(ConfigError, match="choose another port"),
            page_server(fleet(), address, None, name="eval", videos={}.get),
        ):
            pass
