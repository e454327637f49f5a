"""RemoteAgent before there is a server: what its URL and options mean."""

from __future__ import annotations

import pytest

from vlagents_ray import ConfigError, NotReset, Obs, PolicyUnavailable, RemoteAgent
from vlagents_ray.client import agent as module
from vlagents_ray.client.agent import TransportName
from vlagents_ray.wire.observations import JPEG, RAW, ImageCodec


@pytest.mark.parametrize(
    ("url", "transport", "name"),
    [
        ("http://robot:8000", "auto", "auto"),
        ("wss://robot:8000/app", "websocket", "websocket"),
        ("https://robot:8000", "http", "http"),
        ("serve://app", "auto", "auto"),
        ("serve://app", "handle", "handle"),
    ],
)
def test_the_url_and_the_option_decide(url: str, transport: TransportName, name: str) -> None:
    assert RemoteAgent(url, transport=transport).transport == name


@pytest.mark.parametrize(
    ("url", "transport"),
    [
        ("serve://app", "http"),
        ("serve://app", "websocket"),
        ("http://robot:8000", "handle"),
        ("http://robot:8000", "carrier pigeon"),
        ("robot:8000", "auto"),
        ("ftp://robot", "auto"),
        ("http://", "auto"),
    ],
)
def test_what_does_not_go_together_is_refused_at_once(url: str, transport: TransportName) -> None:
    with pytest.raises(ConfigError):
        RemoteAgent(url, transport=transport)


@pytest.mark.parametrize(
    ("url", "codec", "chosen"),
    [
        ("http://127.0.0.1:8000", "auto", RAW),
        ("http://localhost:8000", "auto", RAW),
        ("http://[::1]:8000", "auto", RAW),
        ("http://10.0.0.2:8000", "auto", JPEG),
        ("http://gpu-box:8000", "auto", JPEG),
        ("http://gpu-box:8000", "raw", RAW),
        ("http://127.0.0.1:8000", ImageCodec("jpeg", 50), ImageCodec("jpeg", 50)),
    ],
)
def test_loopback_carries_raw_pixels_and_networks_jpeg(url: str, codec: ImageCodec, chosen: ImageCodec) -> None:
    assert module._codec(url, codec) == chosen


def test_act_before_reset_needs_no_server_to_be_wrong() -> None:
    with pytest.raises(NotReset):
        RemoteAgent("http://127.0.0.1:9").act(Obs())


def test_outside_a_cluster_a_serve_url_says_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"ray\.init"):
        RemoteAgent("serve://app").reset(Obs())


@pytest.mark.parametrize("transport", ["auto", "http", "websocket", "shm"])
def test_a_server_that_is_not_there_is_waited_for_only_so_long(transport: TransportName) -> None:
    with pytest.raises(PolicyUnavailable, match=r"not ready within 0\.2 s"):
        RemoteAgent("http://127.0.0.1:9", transport=transport, connect_timeout_s=0.2).reset(Obs())
