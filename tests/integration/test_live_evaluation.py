"""`vlagents-ray eval … --live`: the page is there while the evaluation runs, with cells and sessions, and then gone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from eval_fakes import LINE, PYTHONPATH, wait_for
from live_server import LivePage
from ray_processes import processes, ray_folder

COMMAND = str(Path(sys.executable).parent / "vlagents-ray")


@pytest.fixture(name="ray_home")
def own_ray_folder() -> Iterator[Path]:
    with ray_folder() as folder:
        yield folder
        assert not processes(folder), "left running"


@contextmanager
def evaluating(ray_home: Path, log: Path, *words: str) -> Iterator[LivePage]:
    """`eval` with these words and a page; it must end with status 0."""
    page = LivePage()
    with (
        log.open("w") as output,
        subprocess.Popen(
            [COMMAND, "eval", *words, "--live-at", page.address],
            env=os.environ | {"RAY_TMPDIR": str(ray_home), "PYTHONPATH": PYTHONPATH},
            stdout=output, stderr=subprocess.STDOUT,
        ) as command,
    ):  # fmt: skip
        try:
            yield page
            assert command.wait(timeout=120) == 0, log.read_text()
        finally:
            command.terminate()
    assert f"live: {page.url}/live" in log.read_text()
    assert page.document() == {}


def test_it_shows_cells_sessions_and_failures_while_it_runs(ray_home: Path, tmp_path: Path) -> None:
    settings = [f"folder={tmp_path}", "trouble={gate: [3]}"]  # the last episode waits for the test
    words = [word for setting in settings for word in ("--env-set", setting)]
    policy = ["--policy", "noop", "--set", "action_dim=1", "--episodes", "4", "--out", str(tmp_path / "out")]
    with evaluating(ray_home, tmp_path / "log", LINE, *policy, *words) as page:
        wait_for(lambda: page.evaluation().get("done") == 3)
        document = page.document()
        said = document["evaluation"]
        assert (said["state"], said["planned"], said["failed"]) == ("running", 4, 3)
        assert said["ends"] is not None
        [cell] = said["cells"]
        assert (cell["policy"], cell["task"], cell["rate"], cell["low"]) == ("noop", LINE, 0.0, 0.0)
        assert [one["outcome"] for one in said["failures"]] == ["failure"] * 3
        [replica] = document["replicas"]
        assert replica["policy"] == "noop"
        assert len(replica["sessions"]) == 1
        assert b"</html>" in page.text()
        (tmp_path / "open").touch()


def test_a_training_gets_a_point_for_each_checkpoint(ray_home: Path, tmp_path: Path) -> None:
    runs, file = tmp_path / "runs", tmp_path / "watched.yaml"
    policy = {
        "name": "mine", "source": "served_agents:Stored", "config": {"checkpoint": str(runs / "{step}" / "number")}
    }  # fmt: skip
    gate = tmp_path / "gate-1"  # while it is there, the last episode does not wait for the test
    gate.touch()
    suites = [{"envs": [LINE], "episodes": 2, "env_options": {"folder": str(tmp_path), "trouble": {"gate": [1]}}}]
    file.write_text(yaml.safe_dump({"policies": [policy], "suites": suites, "video": "none"}))

    def write(step: int) -> None:
        (runs / f"{step}").mkdir(parents=True)
        (runs / f"{step}" / "number").write_text("1")
        (runs / f"{step}" / "done").touch()

    write(10)
    words = ["--watch", str(runs), "--marker", "done", "--until", "20", "--out", str(tmp_path / "out")]
    with evaluating(ray_home, tmp_path / "log", str(file), *words) as page:
        wait_for(lambda: page.evaluation().get("state") == "waiting")
        assert page.steps() == [10]
        gate.unlink()
        write(20)
        wait_for(lambda: page.steps() == [10, 20])
        (tmp_path / "open").touch()
