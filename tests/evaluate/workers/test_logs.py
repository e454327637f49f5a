"""The last of what a process wrote."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import ray

from vlagents_ray.evaluate.workers import cluster
from vlagents_ray.evaluate.workers.cluster import MOST_BYTES, tail, tail_at


def test_the_end_of_each_file_is_kept_under_its_name(tmp_path: Path) -> None:
    (tmp_path / "a.out").write_text("x" * 100_000 + "end of a\n")
    (tmp_path / "a.err").write_text("the error\n")
    found = tail([str(tmp_path / "a.out"), str(tmp_path / "gone"), str(tmp_path / "a.err")])
    assert "end of a\n== a.err\nthe error" in found
    assert found.startswith("== a.out\nxxx")
    assert len(found) < MOST_BYTES


def test_a_process_knows_the_files_that_it_writes_to(tmp_path: Path) -> None:
    code = "from vlagents_ray.evaluate.workers.cluster import own_logs; import sys; print(own_logs(), file=sys.stderr)"
    with (tmp_path / "log").open("w") as file:
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=file, check=True)
    assert (tmp_path / "log").read_text().strip() == str([str(tmp_path / "log")])


@pytest.mark.usefixtures("shared_ray")
def test_another_node_reads_its_own_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "log").write_text("from there")
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    monkeypatch.setattr(cluster, "TIMEOUT_S", 120.0)  # a busy machine starts the process that reads
    [node] = ray.nodes()
    reads = []
    monkeypatch.setattr(cluster, "tail", lambda paths: reads.append(paths) or f"{os.getpid()}")  # not in this process
    assert tail_at(node["NodeManagerHostname"], [str(tmp_path / "log")]) != str(os.getpid())
    assert reads == []


def test_a_host_that_is_gone_has_no_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "nodes", list)
    assert tail_at("gone", ["/log"]) == ""


@pytest.mark.usefixtures("shared_ray")
def test_a_host_that_does_not_answer_is_no_host_without_a_log(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    monkeypatch.setattr(cluster, "TIMEOUT_S", 0.1)
    monkeypatch.setattr(cluster, "tail", lambda _: threading.Event().wait())
    with pytest.raises(TimeoutError, match="did not answer"):
        tail_at(ray.nodes()[0]["NodeManagerHostname"], ["/log"])
