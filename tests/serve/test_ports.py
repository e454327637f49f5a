"""Ports for HAProxy, and the address at which it listens."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve import ports
from vlagents_ray.serve.launch.haproxy import PublicListener, ingress_environment
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK, free_block, free_port, is_free, keep


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process has no claims at the beginning, and those of the test are released at
    its end.
    """
    monkeypatch.setattr(ports, "_claims", deque())
    yield
    while ports._claims:
        os.close(ports._claims.pop())


def free_range(length: int) -> tuple[int, int]:
    """Return a range of free adjacent ports, below the ports that the kernel assigns to
    connections.
    """
    for first in range(10_000, 20_000, length):
        if all(is_free(EVERYWHERE, port) for port in range(first, first + length)):
            return first, first + length
    pytest.fail(f"no {length} free adjacent ports")


@contextmanager
def drawn_elsewhere(setting: str, draw: str, number: int) -> Iterator[set[int]]:
    """Yield the ports that another process has drawn; it lives during the context."""
    program = (
        f"import sys; from vlagents_ray.serve import ports; {setting}\n"
        f"print(*({draw} for _ in range({number})), flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        yield set(map(int, other.stdout.readline().split()))


def test_a_port_that_is_taken_on_one_address_is_not_free_everywhere() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.2", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert is_free(LOOPBACK, port)
        assert not is_free(EVERYWHERE, port)


@pytest.mark.usefixtures("claims")
def test_haproxys_ports_are_different_ones_that_nobody_has(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        first, end = free_range(4)
        taken.bind(("127.0.0.2", first))
        taken.listen()
        monkeypatch.setattr(ports, "_PORTS", (first, end))
        assert sorted(free_port(EVERYWHERE) for _ in range(3)) == [first + 1, first + 2, first + 3]


@pytest.mark.usefixtures("claims")
def test_no_port_is_given_twice_though_nobody_listens_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    first, end = free_range(100)
    monkeypatch.setattr(ports, "_PORTS", (first, end))
    monkeypatch.setattr(ports, "_CLAIMS", 40)
    monkeypatch.setattr(ports, "_excluded", set())
    keep(*range(first, first + 10))
    given = [free_port() for _ in range(200)]  # more than exist, so the oldest are assigned again
    assert min(given) >= first + 10
    assert all(len(set(given[i : i + 40])) == 40 for i in range(160))


@pytest.mark.usefixtures("claims")
def test_two_processes_are_given_different_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    few = free_range(12)
    with drawn_elsewhere(f"ports._PORTS = {few}", "ports.free_port()", 5) as theirs:
        monkeypatch.setattr(ports, "_PORTS", few)
        ours = {free_port() for _ in range(5)}
    assert len(theirs) == len(ours) == 5
    assert not theirs & ours


@pytest.mark.usefixtures("claims")
def test_servers_that_start_at_once_get_different_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    first, end = free_range(60)
    with drawn_elsewhere(f"ports._BLOCKS = {first, end}", "ports.free_block(10)", 3) as theirs:
        monkeypatch.setattr(ports, "_BLOCKS", (first, end))
        ours = {free_block(10) for _ in range(3)}
        assert theirs | ours == set(range(first, end, 10))
        assert free_block(10) in theirs | ours  # a further server shares a block


@pytest.mark.usefixtures("claims")
@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another account")
@pytest.mark.parametrize("listens", ["", "s.listen(0);"], ids=["bound", "listening"])
def test_another_account_cannot_claim_all_ports(
    listens: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = free_range(12)
    squat = (
        "import os, socket, sys; os.setgroups([]); os.setgid(65534); os.setuid(65534); held = []\n"
        f"for port in range(*{few}):\n"
        f"    s = socket.socket(socket.AF_UNIX); s.bind(f'\\0vlagents-ray-port-{{port}}'); "
        f"{listens} held.append(s)\n"
        "print('bound', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", squat], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdin is not None
        assert other.stdout.readline() == b"bound\n"
        monkeypatch.setattr(ports, "_PORTS", few)
        drawn = [free_port() for _ in range(5)]
        other.stdin.close()
    assert set(drawn) <= set(range(*few))


def test_haproxy_alone_faces_the_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    front = PublicListener("192.0.2.7", 8000, inside=8001)
    for key, value in ingress_environment(tmp_path, "/bin/true", front).items():
        monkeypatch.setenv(key, value)
    assert "bind 192.0.2.7:8000\n" in front.settings()
    assert f"server inside {LOOPBACK}:8001\n" in front.settings()
    front.require()
    # A setting that a user may have.
    monkeypatch.setenv("RAY_SERVE_HAPROXY_BALANCE_ALGORITHM", "leastconn")
    with pytest.raises(ConfigError, match="to this function"):
        front.require()


def test_haproxy_starts_with_its_statistics_on_loopback(tmp_path: Path) -> None:
    program = ingress_environment(tmp_path, "/bin/cat")["RAY_SERVE_HAPROXY_BINARY_PATH"]
    settings = tmp_path / "haproxy.cfg"
    settings.write_text("  bind *:9000\n    bind :9001\n    bind 192.0.2.7:9002\n")
    shown = subprocess.run(
        [program, "--", "-f", settings], capture_output=True, text=True, check=False
    ).stdout
    assert shown == "  bind 127.0.0.1:9000\n    bind 127.0.0.1:9001\n    bind 192.0.2.7:9002\n"
    assert ingress_environment(tmp_path, "/bin/cat")["RAY_SERVE_HAPROXY_BINARY_PATH"] == program
