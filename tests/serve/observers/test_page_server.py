"""The live page of a process that is no replica: where it listens, who may watch, and that it ends."""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

import pytest
from in_memory_keys import ChangingKeys

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import open_websocket
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.observers.live_page import page_server
from vlagents_ray.serve.observers.live_view import Fleet

HERE = ("127.0.0.1", 0)
NONE = dict[int, Path]().get


def get(url: str, headers: Mapping[str, str] = {}) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=dict(headers)), timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as refused:
        return refused.code, refused.read()


def fleet() -> Fleet:
    said = {"evaluation": {"done": 1}}
    return Fleet(None, more=lambda: said)


def test_it_is_there_until_the_end_of_the_context() -> None:
    with page_server(fleet(), HERE, None, name="eval", videos={}.get) as url:
        assert get(url)[0] == 200
        status, text = get(url.replace("/live", "/v1/live"))
        assert (status, json.loads(text)["evaluation"]) == (200, {"done": 1})
        assert get(url.replace("/live", "/v1/live"), {"origin": "http://evil.example"})[0] == 403
    with pytest.raises(urllib.error.URLError):
        get(url)


def test_a_viewer_does_not_keep_it_from_ending() -> None:
    with page_server(fleet(), HERE, None, name="eval", videos={}.get) as url:
        viewer = open_websocket(url.replace("http", "ws").replace("/live", "/v1/live"), Credentials(""), 10)
    viewer.close()


def test_videos_are_files_by_number_for_those_who_may_watch(tmp_path: Path) -> None:
    keys = ChangingKeys()
    plain, watching = keys.add("plain"), keys.add("watching", scopes=["watch"])
    (tmp_path / "film.mp4").write_bytes(b"film")
    found = {3: tmp_path / "film.mp4"}
    with page_server(fleet(), HERE, keys.keys, name="eval", videos=found.get) as url:
        videos = url.replace("/live", "/v1/live/videos")
        bearer = {"authorization": f"Bearer {watching}"}
        assert get(f"{videos}/3", bearer) == (200, b"film")
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
    with socket.create_server(HERE) as taken:
        address = ("127.0.0.1", taken.getsockname()[1])
        with (
            pytest.raises(ConfigError, match="choose another port"),
            page_server(fleet(), address, None, name="eval", videos={}.get),
        ):
            pass
