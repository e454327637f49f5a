"""The line protocol between the bench and a driver, here a script that stands for a peer's."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from eval_fakes import wait_for

from vlagents_ray.bench.clients import observation, save_observation
from vlagents_ray.bench.line_process import LineProcess, ProcessFailed
from vlagents_ray.bench.peers import SCRIPTS, PeerClient, peer_connected
from vlagents_ray.serve.launch.server import free_port

FAKE = f"""
import socket, sys
sys.path.insert(0, {str(SCRIPTS)!r})
import peer

def serve(host, port):
    with socket.create_server((host, port)) as server:
        while True:
            server.accept()[0].close()

def drive(host, port, path, mode, out):
    arrays = peer.observation(path)
    print("what libraries print")
    shapes = {{name: array.shape for name, array in arrays.items()}}
    if mode == "broken":
        raise RuntimeError("no such model")
    peer.obey(sys.stdin, out, lambda calls: peer.timed(int, int, calls), {{"shapes": shapes}})

peer.run(serve, drive)
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
    with peer_connected(fake, PYTHON, "127.0.0.1", free_port(), obs) as driver:
        said = driver.ready()
        assert said["shapes"] == {
            "camera_0": [224, 224, 3], "camera_1": [224, 224, 3], "joints": [7], "gripper": []
        }  # fmt: skip
        assert len(driver.measure(25)) == 25
        assert all(ms >= 0 for ms in driver.measure(3))


def test_server_and_driver_end_with_the_context(fake: PeerClient, obs: Path) -> None:
    port = free_port()
    with peer_connected(fake, PYTHON, "127.0.0.1", port, obs) as driver:
        driver.ready()
        driver_pid = driver.child.pid  # type: ignore[attr-defined]
        running = subprocess.run(["pgrep", "-f", fake.script], capture_output=True, text=True, check=True)
        pids = [int(pid) for pid in running.stdout.split()]
        assert driver_pid in pids
        assert len(pids) == 2
    wait_for(lambda: all(gone(pid) for pid in pids))


def test_a_driver_that_breaks_tells_why(fake: PeerClient, obs: Path) -> None:
    broken = PeerClient("fake", "fake", fake.script, "broken", ())
    with (
        peer_connected(broken, PYTHON, "127.0.0.1", free_port(), obs) as driver,
        pytest.raises(ProcessFailed, match=r"(?s)fake: ended with exit status 1.*no such model"),
    ):
        driver.ready()


def test_lines_that_come_together_are_heard_one_by_one() -> None:
    with LineProcess("two lines", ["sh", "-c", "echo 1; echo 2; cat"]) as child:
        assert [child.read(10), child.read(10)] == [1, 2]
        assert child.request("[3]", 10) == [3]


def test_silence_and_nonsense_are_errors() -> None:
    with (
        LineProcess("mute", ["sleep", "60"], end_s=0.1) as mute,
        pytest.raises(ProcessFailed, match=r"no answer within 0\.1 s"),
    ):
        mute.read(0.1)
    with LineProcess("talker", ["echo", "hello"]) as talker, pytest.raises(ProcessFailed, match="want a line of JSON"):
        talker.read(10)


@pytest.mark.parametrize("command", ["serve", "drive"])
def test_a_killed_bench_takes_its_processes_along(fake: PeerClient, obs: Path, command: str) -> None:
    """A driver waits on its input, a server serves; neither is told that the bench has died."""
    port = free_port()
    words = [str(PYTHON), fake.script, command, "127.0.0.1", str(port), str(obs), "raw"]
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
