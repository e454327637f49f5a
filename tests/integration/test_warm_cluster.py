"""`vlagents-ray up` and `down`, and servers and evaluations in the cluster between them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from eval_fakes import wait_for
from listening_sockets import listeners
from live_server import LivePage
from ray_processes import processes, ray_folder
from serve_command import healthy

from vlagents_ray import RemoteAgent
from vlagents_ray.cli.cluster.keeper import idle_workers
from vlagents_ray.evaluate.workers.cluster import worker_variables
from vlagents_ray.interface import Obs
from vlagents_ray.ray_tools.warm_cluster import WarmCluster, warm_cluster
from vlagents_ray.serve.ports import free_port

pytestmark = [pytest.mark.ray, pytest.mark.server]
COMMAND = [str(Path(sys.executable).parent / "vlagents-ray")]
RUN_S = 300


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *words], capture_output=True, text=True, timeout=RUN_S, check=False)


@pytest.fixture(scope="module")
def temporary_files() -> Iterator[Path]:
    """Where the warm cluster of these tests alone is found."""
    with ray_folder() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", str(folder))
        yield folder


@pytest.fixture(scope="module")
def cluster(temporary_files: Path) -> Iterator[WarmCluster]:
    up = run("up", "--port", str(free_port()), "--workers", "1")
    assert up.returncode == 0, up.stderr
    found = warm_cluster()
    assert found is not None
    yield found
    if warm_cluster() is not None:  # not ended by the last test
        run("down")


def address(cluster: WarmCluster) -> str:
    return cluster.url.removeprefix("http://")


class Serving:
    """`vlagents-ray serve noop` in a warm cluster."""

    def __init__(self, cluster: WarmCluster, log: Path) -> None:
        words = ["serve", "noop", "--address", "auto", "--port", address(cluster).rpartition(":")[2]]
        with log.open("w") as output:
            self.process = subprocess.Popen([*COMMAND, *words], stdout=output, stderr=subprocess.STDOUT)
        wait_for(lambda: self.process.poll() is not None or healthy(address(cluster)), RUN_S)
        assert self.process.poll() is None, log.read_text()

    def end(self, number: signal.Signals) -> None:
        self.process.send_signal(number)
        self.process.wait(RUN_S)


def sessions(page: LivePage) -> int:
    return sum(len(replica["sessions"]) for replica in page.document().get("replicas", []))


def test_it_is_one_of_this_user_alone(cluster: WarmCluster) -> None:
    assert cluster.folder.stat().st_mode & 0o777 == 0o700
    again = run("up")
    assert again.returncode == 2
    assert f"is up already, at {cluster.url}" in again.stderr
    found = {one for one in listeners(psutil.Process(cluster.keeper)) if one.kind == "tcp"}
    assert found
    assert {one for one in found if not one.is_local} == set()


def test_processes_wait_for_a_server_and_for_a_worker_of_an_evaluation(cluster: WarmCluster) -> None:
    variables = worker_variables(1, gpus=False)
    wait_for(lambda: idle_workers(str(cluster.folder), variables) == {"replica": 1, "evaluation": 1}, RUN_S)


def test_a_server_and_an_evaluation_run_beside_each_other_and_end_alone(cluster: WarmCluster, tmp_path: Path) -> None:
    server = Serving(cluster, tmp_path / "log")
    with RemoteAgent(cluster.url) as agent:
        agent.reset(Obs(gripper=0.0), "lift")
        assert agent.act(Obs(gripper=0.0)).action is not None
        out = str(tmp_path / "out")
        words = ["tabletop", "--policy", "scripted", "--episodes", "2", "--out", out, "--address", "auto"]
        page, seen = LivePage(), list[int]()
        command = [*COMMAND, "eval", *words, "--live-at", page.address]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as played:
            wait_for(lambda: bool(seen.append(sessions(page)) or seen[-1]) or played.poll() is not None, RUN_S)
            output, errors = played.communicate(timeout=RUN_S)
        assert played.returncode == 0, errors
        assert seen[-1] > 0, "the page did not show the sessions of the cluster's replica"
        assert "2/2" in output
        assert f"live: {page.url}/live" in output
        assert agent.act(Obs(gripper=0.0)).action is not None
    taken = run("serve", "scripted", "--address", "auto", "--port", address(cluster).rpartition(":")[2])
    assert (taken.returncode, "serves 'noop' at the path '/' already" in taken.stderr) == (2, True)
    elsewhere = run("serve", "scripted", "--address", "auto", "--port", "1")
    assert (
        elsewhere.returncode,
        f"the warm cluster listens at {cluster.url.rpartition(':')[2]}" in elsewhere.stderr,
    ) == (
        2,
        True,
    )
    server.end(signal.SIGINT)
    assert server.process.returncode == 0
    assert not healthy(address(cluster))
    assert warm_cluster() == cluster


def test_the_application_of_a_server_that_was_killed_is_removed(cluster: WarmCluster, tmp_path: Path) -> None:
    Serving(cluster, tmp_path / "log").end(signal.SIGKILL)
    wait_for(lambda: not healthy(address(cluster)), RUN_S)
    Serving(cluster, tmp_path / "again").end(signal.SIGINT)


def test_without_its_keeper_it_ends_and_another_one_may_be_started(cluster: WarmCluster, temporary_files: Path) -> None:
    os.kill(cluster.keeper, signal.SIGKILL)
    wait_for(lambda: not cluster.is_kept, RUN_S)
    up = run("up", "--port", str(free_port()), "--workers", "1")
    assert up.returncode == 0, up.stderr
    second = warm_cluster()
    assert second is not None
    assert second.folder != cluster.folder
    down = run("down")
    assert (down.returncode, down.stdout) == (0, "down\n")
    for folder in (cluster.folder, second.folder):
        wait_for(lambda folder=folder: not processes(folder) and not folder.exists(), RUN_S)
    assert warm_cluster() is None
