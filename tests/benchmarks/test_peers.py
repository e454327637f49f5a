"""Clients in other languages and other policy servers: which are measured, and a script that stands for one."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typescript_client
from client_servers import client_servers
from eval_fakes import wait_for

from benchmarks import clients
from benchmarks.own_clients import observation, save_observation
from benchmarks.peers import SCRIPTS, PeerClient, installed, peer_clients, peer_connected
from vlagents_ray.bench.line_process import ProcessFailed
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.launch.server import free_port

FAKE = f"""
import socket, sys
sys.path.insert(0, {str(SCRIPTS)!r})
import peer

def serve(host, port, policy):
    with socket.create_server((host, port)) as server:
        while True:
            server.accept()[0].close()

def connect(target):
    print("what libraries print")
    if target.mode == "broken":
        raise RuntimeError("no such model")
    assert {{name: array.shape for name, array in target.arrays.items()}} == {{
        "camera_0": (224, 224, 3), "camera_1": (224, 224, 3), "joints": (7,), "gripper": ()
    }}
    return peer.Client(lambda: 3, lambda rows: target.policy(rows)[0])

peer.run(serve, connect)
"""
PYTHON = Path(sys.executable)


@pytest.fixture(name="fake")
def fake_script(tmp_path: Path) -> PeerClient:
    script = tmp_path / "fake_peer.py"
    script.write_text(FAKE)
    return PeerClient("fake", "fake", str(script), "raw", ())


@pytest.fixture(name="obs")
def saved_observation(tmp_path: Path) -> Path:
    save_observation(observation(), tmp_path / "obs.npz")
    return tmp_path / "obs.npz"


def gone(pid: int) -> bool:
    status = Path(f"/proc/{pid}/status")
    try:
        return "State:\tZ" in status.read_text()
    except OSError:
        return True


def test_a_driver_gets_the_observation_and_makes_the_calls_it_is_told_to(fake: PeerClient, obs: Path) -> None:
    with peer_connected(fake, PYTHON, obs, {}) as driver:
        driver.ready()
        assert len(driver.measure(25)) == 25
        assert all(ms >= 0 for ms in driver.measure(3))


def test_server_and_driver_end_with_the_context(fake: PeerClient, obs: Path) -> None:
    with peer_connected(fake, PYTHON, obs, {}) as driver:
        driver.ready()
        driver_pid = driver.pid  # type: ignore[attr-defined]
        running = subprocess.run(["pgrep", "-f", fake.script], capture_output=True, text=True, check=True)
        pids = [int(pid) for pid in running.stdout.split()]
        assert driver_pid in pids
        assert len(pids) == 2
    wait_for(lambda: all(gone(pid) for pid in pids))


def test_a_driver_that_breaks_tells_why(fake: PeerClient, obs: Path) -> None:
    broken = PeerClient("fake", "fake", fake.script, "broken", ())
    with (
        peer_connected(broken, PYTHON, obs, {}) as driver,
        pytest.raises(ProcessFailed, match=r"(?s)fake: ended with exit status 1.*no such model"),
    ):
        driver.ready()


@pytest.mark.parametrize("command", ["serve", "drive"])
def test_a_killed_bench_takes_its_processes_along(fake: PeerClient, obs: Path, command: str) -> None:
    """A driver waits on its input, a server serves; neither is told that the bench has died."""
    port = free_port()
    words = [str(PYTHON), fake.script, command, "127.0.0.1", str(port)]
    words += ["{}"] if command == "serve" else [str(obs), "raw", "{}"]
    code = (
        "import subprocess, sys, time\n"
        "p = subprocess.Popen(sys.argv[1:], stdin=subprocess.PIPE)\nprint(p.pid, flush=True)\ntime.sleep(60)"
    )
    with subprocess.Popen([PYTHON, "-c", code, *words], stdout=subprocess.PIPE, text=True) as bench:
        assert bench.stdout is not None
        pid = int(bench.stdout.readline())
        wait_for(lambda: b"fake_peer" in Path(f"/proc/{pid}/cmdline").read_bytes())
        bench.send_signal(signal.SIGKILL)
    wait_for(lambda: gone(pid))


def test_peers_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"vlagent'.*want some of"):
        peer_clients(["vlagent"], tmp_path)
    assert peer_clients([], tmp_path) == ([], {}, {})


def test_a_peer_that_is_not_installed_is_skipped_by_name_with_the_cure(tmp_path: Path) -> None:
    found, skipped, _ = peer_clients(["openpi"], tmp_path / "python")
    assert found == []
    assert "benchmarks.peers" in skipped["openpi"]
    found, skipped, _ = peer_clients(["vlagents"], Path(sys.executable))  # rpyc conflicts with nothing, but is not here
    assert found == []
    assert set(skipped) == {"vlagents"}
    assert "vlagents, rpyc not installed" in skipped["vlagents"]
    assert "benchmarks.peers" in skipped["vlagents"]


def test_versions_are_those_of_the_other_python() -> None:
    assert set(installed(Path(sys.executable), ["numpy", "no-such-thing"])) == {"numpy"}
    with pytest.raises(ConfigError, match="peers-python"):
        installed(Path("/bin/false"), ["numpy"])


@pytest.mark.node
@pytest.mark.compiler
def test_all_clients_are_measured_in_turns() -> None:
    typescript_client.build()
    with client_servers() as urls:
        found = clients.measure_clients(urls["VLAGENTS_TEST_URL"], 20)
    assert [trips.name for trips in found.ours] == ["Python, websocket", "Python, http", clients.CPP, *clients.NODE]
    assert all(trips.rounds.shape == (1, 20) and trips.median > 0 for trips in found.ours)


def test_a_client_that_was_not_built_is_named_with_the_cure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "TYPESCRIPT", tmp_path)
    with pytest.raises(ConfigError, match="npm run build"):
        clients.measure_clients("http://127.0.0.1:9", 1)
