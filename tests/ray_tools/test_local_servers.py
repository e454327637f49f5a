"""The servers of this user on this machine, as a program finds them that wants to join one."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray import ConfigError, join
from vlagents_ray.ray_tools import session as found_here
from vlagents_ray.ray_tools.private import use_loopback
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.ray_tools.session import LocalServer, announce, local_servers


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Let the search find only processes whose Ray is in this test's folder."""
    found = Path.glob

    def ours(self: Path, pattern: str) -> Iterator[Path]:
        for one in found(self, pattern):
            if self != Path("/proc") or str(tmp_path).encode() in environ(one):
                yield one

    monkeypatch.setattr(Path, "glob", ours)
    return tmp_path


def environ(process: Path) -> bytes:
    with contextlib.suppress(OSError):
        return (process / "environ").read_bytes()
    return b""


@contextlib.contextmanager
def raylet(folder: Path, ray_address: str, **environment: str) -> Iterator[None]:
    """Run a process that looks like the daemon of the Ray cluster whose private folder is
    `folder`.
    """
    folder.mkdir(exist_ok=True)
    words = [
        "/ray/raylet",
        "-c",
        "read forever",
        "raylet",
        f"--gcs-address={ray_address}",
        "--node_id=1",
    ]
    with subprocess.Popen(
        words, executable="/bin/sh", env={MARK: str(folder)} | environment, stdin=subprocess.PIPE
    ) as process:
        try:
            # The kernel sets this file after Popen has returned.
            wait_for(Path(f"/proc/{process.pid}/cmdline").read_bytes)
            yield
        finally:
            process.kill()


def ready(
    monkeypatch: pytest.MonkeyPatch, folder: Path, url: str, app: str, ray_address: str
) -> None:
    monkeypatch.setenv(MARK, str(folder))
    announce(url, {app: f"{url}/{app}"}, ray_address)


def test_without_a_server_joining_ends_at_once_with_the_cure() -> None:
    with pytest.raises(
        ConfigError, match=r"no server of this user is ready .* `vlagents-ray serve POLICY`"
    ):
        join()


def test_a_server_that_is_starting_is_not_there_yet_and_one_that_was_killed_no_more(
    alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raylet(alone / "a", "127.0.0.1:1"):
        assert local_servers() == []
        ready(monkeypatch, alone / "a", "http://127.0.0.1:8000", "noop", "127.0.0.1:1")
        [server] = local_servers()
        assert (server.url, server.apps, server.ray_address) == (
            "http://127.0.0.1:8000",
            ("noop",),
            "127.0.0.1:1",
        )
    assert local_servers() == []
    with raylet(alone / "a", "127.0.0.1:2"):  # the daemon of another Ray
        assert local_servers() == []


def test_of_several_servers_one_is_named_by_its_url_or_its_application(
    alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with raylet(alone / "a", "127.0.0.1:1"), raylet(alone / "b", "127.0.0.1:2"):
        ready(monkeypatch, alone / "a", "http://127.0.0.1:8000", "noop", "127.0.0.1:1")
        ready(monkeypatch, alone / "b", "http://127.0.0.1:8001", "pi0", "127.0.0.1:2")
        assert [one.apps for one in local_servers()] == [("noop",), ("pi0",)]
        with pytest.raises(
            ConfigError,
            match=(
                r"expected one server on this machine, got 2, .*8000 \(noop\), .*8001 \(pi0\); "
                r"choose one"
            ),
        ):
            join()
        with pytest.raises(
            ConfigError, match=r"expected the URL or an application .*8000 \(noop\).*, got 'act'"
        ):
            join("act")
        # Then the program prints the server that it found, and stops.
        monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
        for name in (
            "pi0",
            "http://127.0.0.1:8001",
            "http://127.0.0.1:8001/",
            "http://localhost:8001",
        ):
            with pytest.raises(
                ConfigError,
                match=r"RAY_AUTH_MODE=disabled: the Ray of http://127\.0\.0\.1:8001 needs",
            ):
                join(name)


def test_a_program_with_another_token_joins_with_that_of_the_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ray = pytest.importorskip("ray")
    found: dict[str, str] = {}
    monkeypatch.setattr(os, "environ", os.environ | {"RAY_AUTH_TOKEN": "mine"})
    monkeypatch.setattr(ray, "init", lambda *_, **__: found.update(os.environ))
    monkeypatch.setattr("vlagents_ray.ray_tools.private.reread_authentication", lambda: None)
    server = LocalServer("http://127.0.0.1:8000", ("noop",), "127.0.0.1:1", "/run/token")
    monkeypatch.setattr(found_here, "_running_servers", lambda: iter([server]))
    before = use_loopback(True)
    try:
        join()
    finally:
        use_loopback(before)
    tokens = {name: text for name, text in found.items() if name.startswith("RAY_AUTH_TOKEN")}
    assert tokens == {"RAY_AUTH_TOKEN_PATH": "/run/token"}
