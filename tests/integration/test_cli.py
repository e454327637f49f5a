"""`vlagents-ray eval` as users run it: serve, roll out, record, stop and continue."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for
from ray_processes import end, processes, ray_folder, wait_for_end
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import Results

COMMAND = str(Path(sys.executable).parent / "vlagents-ray")


def evaluate(ray_home: Path, *words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [COMMAND, "eval", *words], capture_output=True, text=True, timeout=300, check=False,
        env=os.environ | {"RAY_TMPDIR": str(ray_home), "COLUMNS": "120"}, **options,
    )  # fmt: skip


def rows(out: Path) -> list[tuple[Any, ...]]:
    """Return the recorded values of each episode, without times."""
    if not (out / "results.db").exists():
        return []
    with closing(sqlite3.connect(out / "results.db")) as db:
        if db.execute("SELECT count(*) FROM sqlite_master WHERE name = 'episodes'").fetchone() == (
            0,
        ):
            return []
        columns = (
            "key, episode, seed, status, success_once, success_at_end, steps, "
            "episode_return, instruction"
        )
        return db.execute(f"SELECT {columns} FROM episodes ORDER BY env, episode").fetchall()  # noqa: S608


@pytest.mark.slow
@pytest.mark.vulkan
def test_maniskill_is_solved_whatever_the_number_of_workers(ray_home: Path, tmp_path: Path) -> None:
    found = []
    for workers in ("0", "2"):
        out = tmp_path / workers
        done = evaluate(
            ray_home, "maniskill/PushCube-v1", "--policy", "scripted", "--episodes", "2",
            "--workers", workers, "--video", "none", "--out", str(out),
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        [case] = json.loads((out / "summary.json").read_text())["cases"]
        assert case["success_once"]["successes"] == 2, case
        found.append(rows(out))
    assert len(found[0]) == 2
    assert found[0] == found[1]


def test_kill_dash_nine_and_resume_leave_each_episode_once(ray_home: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = [
        "tabletop",
        "--policy",
        "scripted",
        "--episodes",
        "60",
        "--workers",
        "2",
        "--video",
        "none",
    ]
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
    assert 5 <= len(before) < 60
    refused = CliRunner().invoke(app, ["eval", *words], env={"COLUMNS": "120"})
    assert refused.exit_code == 2
    assert "--resume" in refused.stderr
    done = evaluate(ray_home, *words, "--workers", "0", "--resume")
    assert done.returncode == 0, done.stderr
    after = rows(out)
    assert [row[1] for row in after] == list(range(60))
    assert set(before) <= set(after)


BOTH = ["tabletop", "tabletop/stack", "--policy", "scripted", "--video", "none", "--record", "all"]


@pytest.fixture(scope="module")
def resumed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Begin an evaluation without workers, and resume it with workers."""
    out = tmp_path_factory.mktemp("resumed") / "out"
    with ray_folder() as ray_home:
        for episodes, workers in (("2", "0"), ("4", "2")):
            resume = ["--resume"] * out.exists()
            words = ["--episodes", episodes, "--workers", workers, *resume, "--out", str(out)]
            done = evaluate(ray_home, *BOTH, *words)
            assert done.returncode == 0, done.stdout + done.stderr
        assert not processes(ray_home), "left running"
    return out


def test_results_without_workers_are_those_with_them_which_resume_them(
    ray_home: Path, resumed: Path, tmp_path: Path
) -> None:
    """The fixture `resumed` began without workers and continued with them; this test does the
    reverse.
    """
    words = ["--episodes", "4", "--workers", "0", "--out", str(tmp_path / "whole")]
    done = evaluate(ray_home, *BOTH, *words)
    assert done.returncode == 0, done.stdout + done.stderr

    def outcomes(results: Results) -> list[object]:
        episodes = chain.from_iterable(case.episodes for case in results.cases)
        return [episode.result.outcome for episode in episodes]

    def facts(results: Results) -> dict[str, object]:
        policy = results.policies["scripted"]
        return {key: policy.get(key) for key in ("policy", "config", "contract", "program")}

    whole, in_two_runs = Results.load(tmp_path / "whole"), Results.load(resumed)
    assert len(outcomes(whole)) == 8
    assert outcomes(whole) == outcomes(in_two_runs)
    assert facts(whole) == facts(in_two_runs)


RUNS = """
policies:
  - {name: expert, source: scripted}
  - {name: still, source: noop, config: {action_dim: 4}}
suites:
  - {name: easy, envs: [tabletop/lift, tabletop/slide], episodes: 4}
  - {name: long, envs: [tabletop/lift], episodes: 3, seeds: [0, 100], env_options: {max_steps: 20}}
workers: 1
video: none
"""


def test_a_file_of_runs_is_one_evaluation_of_all(ray_home: Path, tmp_path: Path) -> None:
    file = tmp_path / "nightly.yaml"
    file.write_text(RUNS)
    done = evaluate(ray_home, str(file), cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((tmp_path / "runs" / "nightly" / "summary.json").read_text())
    cases = {
        (one["policy_id"], one["suite"], one["env"]): one["success_once"]
        for one in summary["cases"]
    }
    assert summary["state"] == "complete"
    assert summary["transports"] == ["shm"]
    assert [one["episodes"] for one in cases.values()] == [4, 4, 6] * 2
    assert cases["expert", "easy", "tabletop/lift"]["successes"] == 4
    assert cases["still", "easy", "tabletop/slide"]["successes"] == 0
    again = ["eval", str(file), "--episodes", "9"]
    refused = CliRunner().invoke(app, again, env={"COLUMNS": "120"})
    assert refused.exit_code == 2
    assert "got ['episodes'] as well" in refused.stderr


def command(ray_home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [COMMAND, *words], capture_output=True, text=True, timeout=300, check=False,
        env=os.environ | {"RAY_TMPDIR": str(ray_home), "COLUMNS": "120"},
    )  # fmt: skip


def test_parts_are_merged_exported_and_one_episode_is_played_again(
    ray_home: Path, resumed: Path, tmp_path: Path
) -> None:
    more = tmp_path / "more"
    words = ["--episodes", "4", "--seed", "4", "--workers", "0", "--out", str(more)]
    done = evaluate(ray_home, *BOTH, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    for part in (resumed, more):
        results = Results.load(part)
        code = results.policies["scripted"]["code"]
        assert code == (results.cases[0].code or None)
        # The package's commit is the last one that changed its folder.
        package = results.runs[-1].versions["code"]["vlagents_ray"]
        assert (package is None) == (code is None)
    out = str(tmp_path / "merged")
    merged = command(ray_home, "merge", str(resumed), str(more), "--out", out)
    assert merged.returncode == 0, merged.stdout + merged.stderr
    assert "8/8" in merged.stdout
    exported = command(
        ray_home, "export", out, "--out", str(tmp_path / "dataset"), "--to", "lerobot"
    )
    assert exported.stdout.startswith("wrote 16 episodes"), exported.stdout + exported.stderr
    played_by_a_worker = [row for row in rows(tmp_path / "merged") if row[2] == 3]
    key = played_by_a_worker[0][0]
    same = command(ray_home, "replay", out, key)
    assert same.returncode == 0, same.stdout + same.stderr
    assert "the same: " in same.stdout
    other = CliRunner().invoke(
        app, ["replay", out, key, "--policy", "nope", "--out", str(tmp_path / "other")]
    )
    assert (other.exit_code, "'nope'" in other.stderr) == (2, True), (
        "this server must be used, not the one of the run"
    )
