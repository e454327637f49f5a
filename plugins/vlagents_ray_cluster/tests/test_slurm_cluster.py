"""Tests with a real Slurm with two nodes: jobs that are cancelled, run out of time, and serve."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from slurm import Slurm, no_slurm, running_slurm
from slurm_envs import NOTED

pytestmark = [pytest.mark.hosts, pytest.mark.slow]

CLIENT = """
import json, sys
from vlagents_ray import Obs, RemoteAgent, Unauthorized
with open(sys.argv[1]) as file:
    server = json.load(file)
with RemoteAgent(server["apps"]["noop"], api_key=server["key"]) as agent:
    agent.reset(Obs(), "wait")
    print(agent.act(Obs()).action.tolist())
try:
    RemoteAgent(server["url"], api_key="guessed").reset(Obs(), "wait")
except Unauthorized:
    print("refused")
"""


@pytest.fixture(scope="module")
def slurm() -> Iterator[Slurm]:
    reason = no_slurm()
    if reason is not None:
        pytest.skip(reason)
    with running_slurm(nodes=2, cpus=2) as cluster:
        yield cluster


def command(folder: Path, *more: str) -> list[str]:
    """Return the command of an evaluation of twelve episodes on both nodes; the episodes with seeds
    6 and 7 wait for `folder/open`.
    """
    words = [
        "slurm",
        "eval",
        NOTED,
        "--policy=noop",
        "--set=action_dim=1",
        "--episodes=12",
        f"--out={folder}/out",
    ]
    words += [
        f"--env-set=folder={folder}",
        "--env-set=held=[6, 7]",
        "--nodes=2",
        "--cpus-per-task=2",
        "--gpus-per-node=1",
        "--parsable",
    ]
    return [*words, *more]


def episodes(folder: Path) -> list[tuple[int, int]]:
    """Return (episode, run) of each recorded episode."""
    file = folder / "out" / "results.db"
    if not file.exists():
        return []
    with closing(sqlite3.connect(file)) as db:
        if db.execute("PRAGMA user_version").fetchone() == (0,):
            return []
        return db.execute("SELECT episode, run FROM episodes ORDER BY episode").fetchall()


def held(folder: Path) -> bool:
    """Return whether both waiting episodes are running."""
    return all(any(folder.glob(f"*-{seed}")) for seed in (6, 7))


def test_a_cancelled_evaluation_is_finished_by_the_same_command_with_each_episode_once(
    slurm: Slurm, tmp_path: Path
) -> None:
    job = slurm.vlagents_ray(*command(tmp_path)).strip()
    slurm.wait_for(job, lambda: held(tmp_path) and len(episodes(tmp_path)) == 10)
    slurm.do("scancel", job)
    assert slurm.wait_for_end(job) == "CANCELLED"
    before = episodes(tmp_path)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["state"] == "interrupted"
    assert [episode for episode, _ in before] == [0, 1, 2, 3, 4, 5, 8, 9, 10, 11]

    (tmp_path / "open").touch()
    again = slurm.vlagents_ray(*command(tmp_path)).strip()
    log = tmp_path / "out" / "slurm" / f"{again}.log"
    assert slurm.wait_for_end(again) == "COMPLETED", log.read_text()
    assert episodes(tmp_path) == sorted([*before, (6, 2), (7, 2)])
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["state"] == "complete"
    assert all(f"{node.name} (2 CPUs, 1 GPUs)" in log.read_text() for node in slurm.nodes)
    assert {file.name.partition("-")[0] for file in tmp_path.glob("host*-*")} == {
        node.name for node in slurm.nodes
    }
    logs = tmp_path / "out" / "slurm" / job
    assert {file.name for file in logs.iterdir()} >= {
        f"ray-{node.name}.log" for node in slurm.nodes
    }


def test_a_job_that_is_out_of_time_queues_itself_again_and_goes_on(
    slurm: Slurm, tmp_path: Path
) -> None:
    (tmp_path / "open").touch()
    # The job has one second, in which no episode begins.
    job = slurm.vlagents_ray(
        *command(tmp_path, "--nodes=1", "--time=10", "--closing-s=599", "--resubmit=5")
    ).strip()
    requeued = tmp_path / "out" / "slurm" / job / "requeued"
    slurm.wait_for(job, requeued.exists)
    assert episodes(tmp_path) == []
    slurm.wait_for(job, lambda: slurm.state(job) == "PENDING")
    slurm.do("scontrol", "update", f"job={job}", "TimeLimit=30")
    assert slurm.wait_for_end(job) == "COMPLETED", (
        tmp_path / "out" / "slurm" / f"{job}.log"
    ).read_text()
    assert [episode for episode, _ in episodes(tmp_path)] == list(range(12))


def test_a_server_in_a_job_says_how_to_get_in_and_lets_nobody_else_in(
    slurm: Slurm, tmp_path: Path
) -> None:
    words = [
        "slurm",
        "serve",
        "noop",
        "--set=action_dim=3",
        "--cpus-per-task=2",
        f"--out={tmp_path}",
        "--parsable",
    ]
    job = slurm.vlagents_ray(*words).strip()
    file = tmp_path / job / "server.json"
    slurm.wait_for(job, file.exists)
    assert file.stat().st_mode & 0o777 == 0o600
    output = slurm.login.run([sys.executable, "-c", CLIENT, str(file)]).splitlines()
    assert output == ["[0.0, 0.0, 0.0]", "refused"]
    server = json.loads(file.read_text())
    assert (server["job"], server["host"]) == (int(job), slurm.nodes[0].name)
    log = tmp_path / f"{job}.log"
    slurm.wait_for(job, lambda: str(file) in log.read_text())
    assert server["key"] not in log.read_text()
    assert file.parent.stat().st_mode & 0o777 == 0o700
    slurm.do("scancel", job)
    assert slurm.wait_for_end(job) == "CANCELLED"
