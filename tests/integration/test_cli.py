"""`vlagents-ray eval` as users run it: serve, roll out, record, stop, go on."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for
from ray_processes import end, processes, ray_folder, wait_for_end

from tests.integration.conftest import serving

COMMAND = str(Path(sys.executable).parent / "vlagents-ray")


@pytest.fixture(name="ray_home")
def own_ray_folder() -> Iterator[Path]:
    with ray_folder() as folder:
        yield folder
        assert not processes(folder), "left running"


def evaluate(ray_home: Path, *words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [COMMAND, "eval", *words], capture_output=True, text=True, timeout=300, check=False,
        env=os.environ | {"RAY_TMPDIR": str(ray_home), "COLUMNS": "120"}, **options,
    )  # fmt: skip


def rows(out: Path) -> list[tuple[Any, ...]]:
    """What is recorded of each episode, apart from times."""
    if not (out / "results.db").exists():
        return []
    with closing(sqlite3.connect(out / "results.db")) as db:
        if db.execute("SELECT count(*) FROM sqlite_master WHERE name = 'episodes'").fetchone() == (0,):
            return []
        columns = "key, episode, seed, status, success_once, success_at_end, steps, episode_return, instruction"
        return db.execute(f"SELECT {columns} FROM episodes ORDER BY env, episode").fetchall()  # noqa: S608


def test_the_same_episodes_whatever_the_number_of_workers(ray_home: Path, tmp_path: Path) -> None:
    found = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        done = evaluate(
            ray_home, "tabletop", "--policy", "scripted", "--episodes", "24", "--workers", workers,
            "--video", "none", "--out", str(out),
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        assert "scripted" in done.stdout
        found.append(rows(out))
        summary = json.loads((out / "summary.json").read_text())
        assert summary["state"] == "complete"
        assert summary["totals"][0]["success_once"]["rate"] >= 0.95
        assert summary["transports"] == ["shm"]
    assert len(found[0]) == 24
    assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.vulkan
def test_maniskill_is_solved_whatever_the_number_of_workers(ray_home: Path, tmp_path: Path) -> None:
    found = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        done = evaluate(
            ray_home, "maniskill/PushCube-v1", "maniskill/PickCube-v1", "--policy", "scripted", "--episodes", "10",
            "--workers", workers, "--video", "none", "--out", str(out),
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        for env in json.loads((out / "summary.json").read_text())["cells"]:
            assert env["success_once"]["successes"] >= 9, env
        found.append(rows(out))
    assert len(found[0]) == 20
    assert found[0] == found[1]


def test_kill_dash_nine_and_resume_leave_each_episode_once(ray_home: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["tabletop", "--policy", "scripted", "--episodes", "200", "--workers", "2", "--video", "none"]
    words += ["--out", str(out)]
    with subprocess.Popen(
        [COMMAND, "eval", *words], env=os.environ | {"RAY_TMPDIR": str(ray_home)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    ) as first:  # fmt: skip
        wait_for(lambda: len(rows(out)) >= 5, 120)
        first.send_signal(signal.SIGKILL)
    wait_for_end(ray_home, "Rollout", "bin/haproxy")
    end(ray_home)
    before = rows(out)
    assert 5 <= len(before) < 200
    refused = evaluate(ray_home, *words)
    assert refused.returncode == 2
    assert "--resume" in refused.stderr
    done = evaluate(ray_home, *words, "--resume")
    assert done.returncode == 0, done.stderr
    after = rows(out)
    assert [row[1] for row in after] == list(range(200))
    assert set(before) <= set(after)


def test_a_running_server_is_evaluated_by_its_url(ray_home: Path, tmp_path: Path) -> None:
    with serving("scripted") as server:
        done = evaluate(
            ray_home,
            "tabletop",
            "--policy",
            server.url,
            "--episodes",
            "6",
            "--video",
            "all",
            "--out",
            str(tmp_path / "o"),
        )
        assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "o" / "summary.json").read_text())
    assert summary["config"]["policies"][0]["name"] == "scripted"
    assert summary["transports"] == ["shm"]
    assert len(list((tmp_path / "o" / "videos").rglob("*.mp4"))) == 6


RUNS = """
policies:
  - {name: expert, source: scripted}
  - {name: still, source: noop, config: {action_dim: 4}}
suites:
  - {name: easy, envs: [tabletop/lift, tabletop/slide], episodes: 4}
  - {name: long, envs: [tabletop/lift], episodes: 3, seeds: [0, 100], env_options: {max_steps: 20}}
workers: 2
video: none
"""


def test_a_file_of_runs_is_one_evaluation_of_all(ray_home: Path, tmp_path: Path) -> None:
    file = tmp_path / "nightly.yaml"
    file.write_text(RUNS)
    done = evaluate(ray_home, str(file), cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((tmp_path / "runs" / "nightly" / "summary.json").read_text())
    cells = {(one["contender"], one["suite"], one["env"]): one["success_once"] for one in summary["cells"]}
    assert [one["episodes"] for one in cells.values()] == [4, 4, 6] * 2
    assert cells["expert", "easy", "tabletop/lift"]["successes"] == 4
    assert cells["still", "easy", "tabletop/slide"]["successes"] == 0
    refused = evaluate(ray_home, str(file), "--episodes", "9", cwd=tmp_path)
    assert refused.returncode == 2
    assert "says what is evaluated; got ['episodes'] beside it" in refused.stderr


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["tabletop", "--policy", "nope", "--out", "x"], 2, "nope"),
        (["nowhere", "--policy", "noop", "--out", "x"], 2, "nowhere"),
        (["tabletop", "--out", "x"], 2, "want --policy and --out, or a file of runs"),
        (["absent.yaml"], 2, "'absent.yaml' does not exist"),
        (["tabletop", "--policy", "noop", "--out", "x", "--set", "action_dims=4"], 2, "action_dims"),
        (["tabletop", "--policy", "noop", "--out", "x", "--set", "action_dim"], 2, "KEY=VALUE"),
        (["tabletop", "--policy", "noop", "--out", "x", "--video", "some"], 2, "video"),
        (["tabletop", "--policy", "noop", "--out", "x"], 1, "action.dim: the policy gives 7, the env takes 4"),
    ],
)
def test_mistakes_are_told_in_a_line(ray_home: Path, tmp_path: Path, words: list[str], code: int, text: str) -> None:
    done = evaluate(ray_home, *words, cwd=tmp_path)
    assert done.returncode == code, done.stdout + done.stderr
    assert text in done.stderr
    assert "Traceback" not in done.stderr + done.stdout
