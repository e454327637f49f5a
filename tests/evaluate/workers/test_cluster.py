"""The placement of workers, their environment, and the last output of their processes."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import ray
from in_process_evaluation import flat_config

from vlagents_ray.client.credentials import KEY_VARIABLE, Credentials
from vlagents_ray.envs.graphics import GPUS
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.workers import cluster
from vlagents_ray.evaluate.workers.cluster import (
    MOST_BYTES,
    Placement,
    fewest,
    runtime_env,
    strategy,
    tail,
    tail_at,
)
from vlagents_ray.evaluate.workers.rollout import Rollout


def filled(replicas: dict[str, int], workers: int) -> Counter[str | None]:
    """Return the number of workers per node, when `workers` are placed one after the other."""
    there: Counter[str | None] = Counter()
    for _ in range(workers):
        there[fewest(replicas, there)] += 1
    return there


def test_a_node_gets_as_many_workers_as_it_has_replicas_to_serve_them() -> None:
    assert filled({"a": 1, "b": 1}, 6) == {"a": 3, "b": 3}
    assert filled({"a": 3, "b": 1}, 8) == {"a": 6, "b": 2}


def test_workers_that_are_there_already_count_wherever_they_were_wanted() -> None:
    assert fewest({"a": 1, "b": 1}, {"a": 2, "c": 5}) == "b"


@pytest.mark.parametrize("url", [None, "http://gpu-box:8000/pi0", "ws://gpu-box:8000"])
def test_a_policy_outside_the_cluster_draws_workers_nowhere(url: str | None) -> None:
    assert Placement().node(url, {}) is None
    assert strategy(None) == "SPREAD"


def test_a_worker_is_never_bound_to_a_node_that_is_full_or_gone() -> None:
    wanted = strategy("ab" * 28)
    assert (wanted.soft, wanted._spill_on_unavailable) == (True, True)


def case(url: str | None = "http://box", **worker: Any) -> EvalCase:
    [found] = plan_cases(flat_config(envs=["tabletop/reach"], out="out", policy_url=url, **worker))
    return found


def test_gpus_are_hidden_from_workers_that_are_given_none() -> None:
    assert runtime_env(case())["env_vars"][GPUS] == ""


def test_gpus_are_not_hidden_from_their_owner_nor_where_the_user_says_otherwise_nor_from_a_policy_in_the_worker() -> (
    None
):
    assert GPUS not in runtime_env(case(gpus_per_worker=0.25))["env_vars"]
    assert runtime_env(case(runtime_env={"env_vars": {GPUS: "1"}}))["env_vars"][GPUS] == "1"
    assert GPUS not in runtime_env(case(url=None))["env_vars"]


def test_the_key_of_a_server_is_in_no_runtime_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray logs runtime environments, and every user can read these logs. The key is sent with a
    worker's first call.
    """
    monkeypatch.setenv(KEY_VARIABLE, "vlr_x")
    assert "vlr_x" not in str(runtime_env(case()))
    credentials = Credentials()
    assert "vlr_x" not in repr(credentials)
    monkeypatch.delenv(KEY_VARIABLE)
    Rollout(lambda _: pytest.fail("made"), lambda _: pytest.fail("made")).ready(credentials)
    assert Credentials().api_key == "vlr_x"


def test_the_end_of_each_file_is_kept_under_its_name(tmp_path: Path) -> None:
    (tmp_path / "a.out").write_text("x" * 100_000 + "end of a\n")
    (tmp_path / "a.err").write_text("the error\n")
    found = tail([str(tmp_path / "a.out"), str(tmp_path / "gone"), str(tmp_path / "a.err")])
    assert "end of a\n== a.err\nthe error" in found
    assert found.startswith("== a.out\nxxx")
    assert len(found) < MOST_BYTES


def test_a_process_knows_the_files_that_it_writes_to(tmp_path: Path) -> None:
    code = (
        "from vlagents_ray.evaluate.workers.rollout import own_logs; import sys; "
        "print(own_logs(), file=sys.stderr)"
    )
    with (tmp_path / "log").open("w") as file:
        subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=file, check=True
        )
    assert (tmp_path / "log").read_text().strip() == str([str(tmp_path / "log")])


@pytest.mark.usefixtures("shared_ray")
def test_another_node_reads_its_own_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "log").write_text("from there")
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    # A busy machine takes long to start the process that reads.
    monkeypatch.setattr(cluster, "TIMEOUT_S", 120.0)
    [node] = ray.nodes()
    reads = []
    # This function must not be called in this process.
    monkeypatch.setattr(cluster, "tail", lambda paths: reads.append(paths) or f"{os.getpid()}")
    assert tail_at(node["NodeManagerHostname"], [str(tmp_path / "log")]) != str(os.getpid())
    assert reads == []


def test_a_host_that_is_gone_has_no_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "nodes", list)
    assert tail_at("gone", ["/log"]) == ""


@pytest.mark.usefixtures("shared_ray")
def test_a_host_that_does_not_answer_is_no_host_without_a_log(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    monkeypatch.setattr(cluster, "TIMEOUT_S", 0.1)
    monkeypatch.setattr(cluster, "tail", lambda _: threading.Event().wait())
    with pytest.raises(TimeoutError, match="did not answer"):
        tail_at(ray.nodes()[0]["NodeManagerHostname"], ["/log"])
