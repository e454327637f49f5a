"""Evaluations in separate processes with a separate Ray, which are stopped from outside."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from subprocess import Popen

import pytest
from eval_fakes import wait_for
from ray_processes import leaked, processes, ray_folder, wait_for_end

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.evaluate import EvalConfig

pytestmark = [pytest.mark.ray, pytest.mark.slow]
KEY = f"vlr_{os.urandom(8).hex()}"  # a unique key, since other tests may run at the same time

SCRIPT = """
import sys
from eval_fakes import ToZero
from vlagents_ray.evaluate import EvalConfig, EvaluationInterrupted, evaluate

try:
    evaluate(EvalConfig.model_validate_json(sys.argv[1]), agent_factory=ToZero)
except EvaluationInterrupted:
    sys.exit(130)
"""


@pytest.fixture(name="ray_folder")
def own_ray_folder() -> Iterator[Path]:
    with ray_folder() as folder:
        yield folder


def start(config: EvalConfig, ray_folder: Path) -> Popen[bytes]:
    env_vars = config.worker.runtime_env["env_vars"]
    assert isinstance(env_vars, dict)
    environment = {
        **os.environ,
        "PYTHONPATH": str(env_vars["PYTHONPATH"]),
        "RAY_TMPDIR": str(ray_folder),
        "RAY_USAGE_STATS_ENABLED": "0",
        KEY_VARIABLE: KEY,
    }
    command = [sys.executable, "-c", SCRIPT, config.model_dump_json()]
    return Popen(command, env=environment, start_new_session=True)


def episodes(config: EvalConfig) -> list[tuple[int, int, int]]:
    """Return (run, episode, attempts) of each recorded episode."""
    if not (config.out / "results.db").exists():
        return []
    with closing(sqlite3.connect(config.out / "results.db")) as db:
        if db.execute("PRAGMA user_version").fetchone() == (0,):
            return []
        return db.execute("SELECT run, episode, attempts FROM episodes ORDER BY episode").fetchall()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGKILL, -9), (signal.SIGINT, 130)])
def test_a_stopped_and_resumed_evaluation_has_each_episode_exactly_once(
    config: Callable[..., EvalConfig],
    tmp_path: Path,
    ray_folder: Path,
    number: signal.Signals,
    code: int,
) -> None:
    options = {"folder": str(tmp_path), "trouble": {"gate": [5, 6]}}
    settings = config(episodes=9, env_options=options, env_timeout_s=100)

    with start(settings, ray_folder) as evaluation:
        wait_for(lambda: all((tmp_path / f"gate-{seed}").exists() for seed in (5, 6)))
        # Both workers are in the middle of an episode.
        wait_for(lambda: len(episodes(settings)) == 5)
        # A process that is starting has its parent's environment for a moment.
        wait_for(lambda: leaked(KEY, [ray_folder]) == [f"/proc/{evaluation.pid}/environ"])
        if number == signal.SIGKILL:
            evaluation.kill()
        else:
            os.killpg(evaluation.pid, number)  # like a terminal or a service manager does
        assert evaluation.wait(300) == code
    wait_for_end(ray_folder, "Rollout")
    wait_for(lambda: not processes(ray_folder) and not [*ray_folder.iterdir()])
    assert [episode for _, episode, _ in episodes(settings)] == [0, 1, 2, 3, 4]
    if number != signal.SIGKILL:
        assert json.loads((settings.out / "summary.json").read_text())["state"] == "interrupted"

    # This run needs no further Ray; tests/integration/test_cli.py resumes with workers.
    with start(
        config(episodes=9, env_options=options, workers=0, resume=True), ray_folder
    ) as evaluation:
        assert evaluation.wait(300) == 0
    assert episodes(settings) == [(1, i, 1) for i in range(5)] + [(2, i, 1) for i in range(5, 9)]
    summary = json.loads((settings.out / "summary.json").read_text())
    assert (
        summary["state"],
        summary["totals"][0]["episodes"],
        summary["totals"][0]["retries"],
    ) == ("complete", 9, 0)
