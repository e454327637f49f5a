"""Other policy servers: which of them are measured, and a script that stands in for such a
system.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from eval_fakes import wait_for
from peer_environment import peers_python

from benchmarks.line_process import ProcessFailed
from benchmarks.own_clients import observation, save_observation
from benchmarks.peers import (
    PEER_CLIENTS,
    SCRIPTS,
    PeerClient,
    PeerServer,
    alone,
    installed,
    peer_clients,
    peer_connected,
    serving,
)
from benchmarks.processes import descendants
from benchmarks.throughput import ThroughputPlan, peer_fleet
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.ports import free_port

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
FEW = ThroughputPlan(
    config={"base_ms": 2.0, "per_item_ms": 1.0}, batch=2, clients=(2,), peers_python=PYTHON
)


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


def test_a_driver_gets_the_observation_and_makes_the_calls_it_is_told_to(
    fake: PeerClient, obs: Path
) -> None:
    with peer_connected(fake, PYTHON, obs, {}) as driver:
        driver.ready()
        assert len(driver.measure(25)) == 25
        assert all(ms >= 0 for ms in driver.measure(3))


def test_server_and_driver_end_with_the_context(fake: PeerClient, obs: Path) -> None:
    with peer_connected(fake, PYTHON, obs, {}) as driver:
        driver.ready()
        driver_pid = driver.pid  # type: ignore[attr-defined]
        running = subprocess.run(
            ["pgrep", "-f", fake.script], capture_output=True, text=True, check=True
        )
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


def test_a_server_that_ends_is_named_before_its_clients_have_waited_for_it(
    fake: PeerClient, obs: Path
) -> None:
    script = Path(fake.script)
    serve = "def serve(host, port, policy):\n"
    script.write_text(FAKE.replace(serve, f"{serve}    raise RuntimeError('no memory')\n"))
    with (
        peer_connected(fake, PYTHON, obs, {}) as driver,
        pytest.raises(
            ProcessFailed, match=r"(?s)fake, server: ended with exit status 1.*no memory"
        ),
    ):
        driver.ready()


@pytest.mark.parametrize("command", ["serve", "drive"])
def test_a_killed_bench_takes_its_processes_along(
    fake: PeerClient, obs: Path, command: str
) -> None:
    """A driver waits for input and a server serves; neither is notified when the bench dies."""
    port = free_port()
    words = [str(PYTHON), fake.script, command, "127.0.0.1", str(port)]
    words += ["{}"] if command == "serve" else [str(obs), "raw", "{}"]
    code = (
        "import subprocess, sys, time\n"
        "p = subprocess.Popen(sys.argv[1:], stdin=subprocess.PIPE)\nprint(p.pid, "
        "flush=True)\ntime.sleep(60)"
    )
    with subprocess.Popen([PYTHON, "-c", code, *words], stdout=subprocess.PIPE, text=True) as bench:
        assert bench.stdout is not None
        pid = int(bench.stdout.readline())
        wait_for(lambda: b"fake_peer" in Path(f"/proc/{pid}/cmdline").read_bytes())
        bench.send_signal(signal.SIGKILL)
    wait_for(lambda: gone(pid))


POLLING = """
import multiprocessing

peer.die_with_parent()  # as in processes that a script in the folder of the peers spawns

def child(up):
    up.set()
    multiprocessing.Event().wait()

def serve(host, port, policy):
    spawn = multiprocessing.get_context("spawn")
    up = spawn.Event()
    spawn.Process(target=child, args=(up,), daemon=True).start()
    up.wait()
    with socket.create_server((host, port)) as server:
        multiprocessing.Event().wait()

if __name__ == "__main__":
    peer.run(serve, connect)
"""
KILLED = """
import sys, time
from pathlib import Path
from benchmarks.peers import PeerClient, peer_connected

one = PeerClient("fake", "fake", sys.argv[1], "raw", (), polls=True)
with peer_connected(one, Path(sys.executable), Path(sys.argv[2]), {}) as driver:
    driver.ready()
    print("stopped", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_a_killed_bench_takes_the_processes_of_a_server_along_that_it_has_stopped(
    tmp_path: Path, obs: Path
) -> None:
    script = tmp_path / "polling_peer.py"
    script.write_text(FAKE.removesuffix("peer.run(serve, connect)\n") + POLLING)
    with subprocess.Popen(
        [PYTHON, "-c", KILLED, str(script), str(obs)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=SCRIPTS.parents[1],
    ) as bench:
        assert bench.stdout is not None
        assert bench.stdout.readline() == "stopped\n"
        pids = descendants(bench.pid)
        assert len(pids) == 4  # also the client, and the helper process of multiprocessing
        # The server and its child process; a signal takes a moment.
        wait_for(lambda: sum(state(pid) == "T" for pid in pids) == 2)
        bench.send_signal(signal.SIGKILL)
    wait_for(lambda: all(gone(pid) for pid in pids), 10.0)


def state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_server_that_polls_is_stopped_between_the_turns_of_its_clients(
    fake: PeerClient, obs: Path
) -> None:
    polling = replace(fake, polls=True, shares=True)
    running: dict[str, PeerServer] = {}
    with peer_connected(polling, PYTHON, obs, running) as driver:
        server = running[fake.script]
        assert server.process is not None
        driver.ready()
        wait_for(lambda: state(server.process.pid) == "T")
        assert len(driver.measure(2)) == 2
        wait_for(lambda: state(server.process.pid) == "T")
        with server.turn():
            wait_for(lambda: state(server.process.pid) != "T")
    assert gone(server.process.pid)
    assert running == {}


def test_clients_of_one_script_share_a_server_if_it_says_so(fake: PeerClient, obs: Path) -> None:
    for shares in (True, False):
        one, running = replace(fake, shares=shares), {}
        with (
            serving(one, PYTHON, running, {}) as first,
            serving(one, PYTHON, running, {}) as second,
        ):
            assert (first.address == second.address) is shares


@pytest.mark.slow
def test_a_fleet_makes_load_with_the_policy_of_the_plan(fake: PeerClient, obs: Path) -> None:
    for one in (fake, replace(fake, one_process=True)):
        with peer_fleet(one, FEW, obs, {}) as fleet:
            assert len(fleet.parts) == (1 if one.one_process else 3)
            both = fleet.run(0, 2, 0.1)
            robot, simulation = fleet.run(1, 1, 0.3)
        assert len(both) == 2
        for calls in (*both, simulation, robot):
            # 2 ms and 1 ms per row for three rows, as the stand-in reports.
            assert all(rest == [5.0, 3] for _, _, *rest in calls)
        assert 0 < len(robot) < len(simulation)


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
@pytest.mark.parametrize("client", PEER_CLIENTS, ids=lambda client: client.name)
def test_a_peer_answers_its_own_clients(client: PeerClient, obs: Path) -> None:
    python = peers_python()
    peers_python(client.environment)
    if not client.several:
        with peer_connected(client, python, obs, {}) as driver:
            driver.ready()
            assert len(driver.measure(5)) == 5
        return
    with peer_fleet(client, replace(FEW, peers_python=python), obs, {}) as fleet:
        robot, simulation = fleet.run(1, 1, 2.0)
    assert robot
    assert simulation
    assert {(inference, rows) for _, _, inference, rows in (*robot, *simulation)} <= {
        (3.0, 1),
        (4.0, 2),
    }


def test_a_peer_does_not_get_the_settings_of_our_running_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RAY_SERVE_ENABLE_HA_PROXY", "1")
    monkeypatch.setenv("VLAGENTS_RAY_HOST", "127.0.0.1")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    changes = alone()
    assert [
        changes.get(name, "kept") for name in ("RAY_SERVE_ENABLE_HA_PROXY", "VLAGENTS_RAY_HOST")
    ] == [None, None]
    assert "RAY_USAGE_STATS_ENABLED" not in changes


def test_a_peer_writes_compiled_files_whatever_the_shell_says() -> None:
    """Without them, each process of plain Ray Serve started too late, and never caught up."""
    program = "import os; print(os.environ.get('PYTHONDONTWRITEBYTECODE', 'unset'))"
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1", **alone()}
    kept = {name: value for name, value in environment.items() if value is not None}
    done = subprocess.run(
        [sys.executable, "-c", program], env=kept, capture_output=True, text=True, check=True
    )
    assert done.stdout == "unset\n"


def test_peers_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"expected only \[.*got \['vlagent'\]"):
        peer_clients(["vlagent"], tmp_path)
    assert peer_clients([], tmp_path) == ([], {}, {})


def test_a_peer_that_is_not_installed_is_skipped_by_name_with_the_cure(tmp_path: Path) -> None:
    found, skipped, _ = peer_clients(["openpi"], tmp_path / "python")
    assert found == []
    assert "benchmarks.peers" in skipped["openpi"]
    # rpyc conflicts with nothing, but is not installed here.
    found, skipped, _ = peer_clients(["vlagents"], Path(sys.executable))
    assert found == []
    assert set(skipped) == {"vlagents"}
    assert "vlagents, rpyc not installed" in skipped["vlagents"]
    assert "benchmarks.peers" in skipped["vlagents"]


def test_versions_are_those_of_the_other_python() -> None:
    assert set(installed(Path(sys.executable), ["numpy", "no-such-thing"])) == {"numpy"}
    with pytest.raises(ConfigError, match="peers-python"):
        installed(Path("/bin/false"), ["numpy"])
