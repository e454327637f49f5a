"""Ports for HAProxy, and the address that it listens at."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve import ports
from vlagents_ray.serve.haproxy import behind_haproxy, ingress_environment
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK, free_ports, is_free


def test_a_port_that_is_taken_on_one_address_is_not_free_everywhere() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.2", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert is_free(LOOPBACK, port)
        assert not is_free(EVERYWHERE, port)


def test_haproxys_ports_are_different_ones_that_nobody_has(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        for first in range(41_000, 42_000, 4):
            if all(is_free(EVERYWHERE, port) for port in range(first, first + 4)):
                break
        taken.bind(("127.0.0.2", first))
        taken.listen()
        monkeypatch.setattr(ports, "_PORTS", (first, first + 4))
        assert free_ports(3) == [first + 1, first + 2, first + 3]


def test_a_single_address_is_haproxys_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for key, value in ingress_environment(tmp_path, "192.0.2.7", 8000).items():
        monkeypatch.setenv(key, value)
    assert behind_haproxy("192.0.2.7", 8000) == LOOPBACK
    for host in (LOOPBACK, "localhost", EVERYWHERE):
        assert behind_haproxy(host, 8000) == host
    with pytest.raises(ConfigError, match=EVERYWHERE):
        behind_haproxy("192.0.2.8", 8000)
    monkeypatch.delenv("RAY_SERVE_ENABLE_HA_PROXY")
    assert behind_haproxy("192.0.2.8", 8000) == "192.0.2.8"
