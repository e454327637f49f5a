"""`vlagents-ray eval` with a live page, and with a trainer that is still running: `--live-at` and
`--watch`.

The page exists while the evaluation runs, with its cases and sessions, and disappears afterwards.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml
from eval_fakes import LINE, PYTHONPATH, wait_for
from live_server import LivePage

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import Results

COMMAND = str(Path(sys.executable).parent / "vlagents-ray")


@contextmanager
def evaluating(ray_home: Path, log: Path, *words: str) -> Iterator[LivePage]:
    """Run `eval` with these arguments and a page; it must end with status 0."""
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


def test_it_shows_cases_sessions_and_failures_while_it_runs(ray_home: Path, tmp_path: Path) -> None:
    # The last episode waits until the test opens the gate.
    settings = [f"folder={tmp_path}", "trouble={gate: [3]}"]
    words = [word for setting in settings for word in ("--env-set", setting)]
    policy = [
        "--policy",
        "noop",
        "--set",
        "action_dim=1",
        "--episodes",
        "4",
        "--out",
        str(tmp_path / "out"),
    ]
    with evaluating(ray_home, tmp_path / "log", LINE, *policy, *words) as page:
        wait_for(lambda: page.evaluation().get("done") == 3)
        document = page.document()
        said = document["evaluation"]
        assert (said["state"], said["planned"], said["failed"]) == ("running", 4, 3)
        assert said["ends"] is not None
        [case] = said["cases"]
        assert (case["policy"], case["task"], case["rate"], case["low"]) == ("noop", LINE, 0.0, 0.0)
        assert [one["outcome"] for one in said["failures"]] == ["failure"] * 3
        [replica] = document["replicas"]
        assert replica["policy"] == "noop"
        assert len(replica["sessions"]) == 1
        assert b"</html>" in page.text()
        (tmp_path / "open").touch()


def finished(out: Path) -> dict[str, int]:
    """Return the number of finished episodes of each policy_id."""
    with suppress(ConfigError):
        return {case.policy_id: len(case.counted) for case in Results.load(out).cases}
    return {}


def written(folder: Path, step: int, number: str, *, done: bool) -> None:
    """Write a checkpoint for `served_agents.Stored`."""
    (folder / f"{step}").mkdir(exist_ok=True)
    (folder / f"{step}" / "number").write_text(number)
    if done:
        (folder / f"{step}" / "done").touch()


def test_each_checkpoint_is_evaluated_once_it_is_whole_by_one_server_and_gets_a_point(
    ray_home: Path, tmp_path: Path
) -> None:
    runs, out, file = tmp_path / "runs", tmp_path / "out", tmp_path / "watched.yaml"
    runs.mkdir()
    policy = {
        "name": "mine",
        "source": "served_agents:Stored",
        "config": {"checkpoint": str(runs / "{step}" / "number")},
    }
    suites = [{"envs": [LINE], "episodes": 2}]
    file.write_text(
        yaml.safe_dump({"policies": [policy], "suites": suites, "out": str(out), "video": "none"})
    )
    written(runs, 20, "half a numb", done=False)
    words = [str(file), "--watch", str(runs), "--marker", "done", "--until", "30"]
    with evaluating(ray_home, tmp_path / "log", *words) as page:
        written(runs, 10, "0.5", done=True)
        wait_for(lambda: finished(out) == {"mine@10": 2}, 180)
        wait_for(lambda: page.evaluation().get("state") == "waiting")
        assert page.steps() == [10]
        written(runs, 20, "-0.5", done=True)
        wait_for(lambda: page.steps() == [10, 20])
        written(runs, 30, "1.0", done=True)
    results = Results.load(out)
    assert finished(out) == {"mine@10": 2, "mine@20": 2, "mine@30": 2}
    assert [case.counted[0].checkpoint for case in results.cases] == [
        str(runs / f"{n}" / "number") for n in (10, 20, 30)
    ]
    assert [case.step for case in results.cases] == [10, 20, 30]
    assert "step 20: not yet: has no done" in (tmp_path / "log").read_text()
    assert {one["checkpoint"] for one in results.policies.values()} == {
        str(runs / "30" / "number")
    }, "the server has the last checkpoint"
