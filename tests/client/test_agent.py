"""RemoteAgent before a server exists: the meaning of its URL and options."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from vlagents_ray import ConfigError, NotReset, Obs, PolicyUnavailable, RemoteAgent
from vlagents_ray.client.credentials import warn_of_plain_http
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import copied


@pytest.mark.parametrize(
    ("url", "transport", "name"),
    [
        ("http://robot:8000", "auto", "auto"),
        ("wss://robot:8000/app", "websocket", "websocket"),
        ("https://robot:8000", "http", "http"),
        ("serve://app", "auto", "auto"),
        ("serve://app", "handle", "handle"),
        ("serve://app", "http", None),
        ("serve://app", "websocket", None),
        ("http://robot:8000", "handle", None),
        ("http://robot:8000", "carrier pigeon", None),
        ("robot:8000", "auto", None),
        ("ftp://robot", "auto", None),
        ("http://", "auto", None),
    ],
)
def test_the_url_and_the_option_decide_or_are_refused_at_once(
    url: str, transport: TransportName, name: str | None
) -> None:
    with contextlib.nullcontext() if name is not None else pytest.raises(ConfigError):
        assert RemoteAgent(url, transport=transport).transport == name


def test_what_is_wrong_without_a_server_needs_none() -> None:
    with pytest.raises(
        InvalidInput,
        match=r"expected one of \['auto', 'exact', 'raw', 'lossless', 'jpeg'\], got 'webp'",
    ):
        RemoteAgent("http://gpu-box:8000", codec="webp")
    with pytest.raises(NotReset):
        RemoteAgent("http://127.0.0.1:9").act(Obs())
    with pytest.raises(ConfigError, match=r"ray\.init"):
        RemoteAgent("serve://app").reset(Obs())


@pytest.mark.parametrize("transport", ["auto", "http", "websocket", "shm"])
def test_a_server_that_is_not_there_is_waited_for_only_so_long(transport: TransportName) -> None:
    with pytest.raises(PolicyUnavailable, match=r"not ready within 0\.2 s"):
        RemoteAgent("http://127.0.0.1:9", transport=transport, connect_timeout_s=0.2).reset(Obs())


@pytest.mark.parametrize(
    ("url", "key", "warned"),
    [
        ("http://robot-box:8001", "vlr_k", True),
        ("ws://192.0.2.1:8001", "vlr_k", True),
        ("https://robot-box:8001", "vlr_k", False),
        ("http://127.0.0.1:8001", "vlr_k", False),
        ("http://localhost:8001", "vlr_k", False),
        ("http://robot-box:8002", "", False),
    ],
)
def test_a_key_that_goes_unencrypted_over_a_network_is_warned_of_once(
    url: str, key: str, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_plain_http.cache_clear()
    for _ in range(3):
        RemoteAgent(url, api_key=key)
    lines = [
        record.getMessage() for record in caplog.records if "unencrypted" in record.getMessage()
    ]
    assert len(lines) == warned
    assert "vlr_k" not in caplog.text


def test_a_copy_of_an_observation_shares_no_memory_however_its_info_is_nested() -> None:
    depth = np.zeros((2, 2), np.float32)
    obs = Obs(info={"depth": {"front": depth}, "scans": [depth], "note": "seen"})
    copy = copied(obs)
    depth[:] = 1
    assert copy.info["note"] == "seen"
    assert not copy.info["depth"]["front"].any()
    assert not copy.info["scans"][0].any()
