"""examples/learn/flow.py: the reference policy's flow, improved by GRPO and PPO, at a small
size.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import flow
import numpy as np
import pytest
from flow import EXECUTE, HEAD, FlowLearner, FlowPlan, FlowRun, Method
from grpo import group_advantages
from ray_processes import processes, ray_folder

from vlagents_ray.evaluate import Results
from vlagents_ray.policies.reference.network import read_network

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"NUM_ENVS": 8, "BATCH": 32, "TICKS": 32, "SHORT": 16, "LONG": 20}.items():
        monkeypatch.setattr(flow, name, value)


def plan(method: Method, out: Path, **options: Any) -> FlowPlan:
    settings = {
        "method": method,
        "out": out,
        "iterations": 1,
        "episodes": 16,
        "held_out": 4,
        "epochs": 1,
    }
    return FlowPlan.model_validate(settings | options)


def test_the_earlier_a_task_is_solved_the_larger_is_its_advantage() -> None:
    success = [False, False, True, True, True, False, False, False, False]
    found = {"t": [0, 1, 2, 3, 0, 0, 1, 2, 3], "success": success, "episode": [7] * 9}
    columns = {name: np.array(values) for name, values in found.items()}
    solved = np.array([0.9**2, 1.0, 0.0])
    late, early, never = (solved - solved.mean()) / (solved.std() + 1e-6)
    np.testing.assert_allclose(
        group_advantages(columns, 0.9), [late] * 3 + [0, early] + [never] * 4, rtol=1e-5
    )


@pytest.mark.parametrize("method", get_args(Method))
def test_a_run_trains_the_flow_alone_and_writes_results_and_a_checkpoint(
    method: Method,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    learned = []
    improve = FlowLearner.improve
    monkeypatch.setattr(
        FlowLearner,
        "improve",
        lambda self, columns: learned.append(improve(self, columns)) or learned[-1],
    )
    run = FlowRun(plan(method, tmp_path / "run"))
    run.learn()
    [one] = learned
    assert one.acts
    assert 0 < one.log_ratio < 1e-4, "the policy and the learner agree before the first step"
    assert Results.load(tmp_path / "run" / "within_16").policy_ids == [f"{method}@0", f"{method}@1"]

    sizes = flow.read_checkpoint(flow.CHECKPOINT).sizes
    old = read_network(sizes, flow.CHECKPOINT).state_dict()
    new = read_network(sizes, tmp_path / "run" / "checkpoint").state_dict()
    moved = {
        name.partition(".")[0] for name, value in old.items() if not torch.equal(value, new[name])
    }
    assert moved == set(HEAD)

    flow.compare_runs([tmp_path / "run", tmp_path / "run"])
    said = capsys.readouterr().out
    assert "within 16 ticks: " in said
    assert "gain: " in said


def test_an_iteration_whose_groups_all_fail_teaches_nothing_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(flow, "TICKS", 4)  # too few to solve anything
    run = FlowRun(plan("grpo", tmp_path / "run", iterations=2, episodes=8))
    run.learn()
    assert run._learner.version == 0
    assert "iteration 2: 0.0% of 8 episodes solved" in capsys.readouterr().out


def test_a_learners_step_makes_good_acts_likelier(tmp_path: Path) -> None:
    run = FlowRun(plan("grpo", tmp_path / "run"))
    with run._policy() as (_, acting), run._rollouts(acting) as rollouts:
        columns = flow.arrays(rollouts.collect(16))
    starts, lengths = flow.episodes(columns)
    columns = {**columns, "success": np.zeros(len(columns["t"]), bool)}
    columns["success"][starts[0] + lengths[0] - 1] = True  # one of the first group is good
    learner = run._learner
    contexts, chains = learner._contexts(columns), torch.from_numpy(columns["replay.chain"].copy())
    with torch.no_grad():
        before = learner._logprob(contexts, chains)
    assert before.shape == (len(contexts), EXECUTE)
    learner.improve(columns)
    with torch.no_grad():
        rise = (learner._logprob(contexts, chains) - before).sum(1).numpy()
    acts = lengths[0] // EXECUTE
    assert rise[:acts].mean() > rise[acts : 8 * acts].mean()


@pytest.mark.server
@pytest.mark.slow
@pytest.mark.integration
def test_a_worker_plays_while_the_learner_learns_and_no_episode_is_older_than_the_lag(
    tmp_path: Path,
) -> None:
    with ray_folder() as folder:
        command = [
            sys.executable,
            flow.__file__,
            "learn",
            "grpo",
            "--out",
            str(tmp_path / "run"),
            "--max-lag",
            "1",
        ]
        command += ["--iterations", "2", "--episodes", "64", "--held-out", "2"]
        done = subprocess.run(
            command,
            env=os.environ | {"RAY_TMPDIR": str(folder)},
            capture_output=True,
            text=True,
            timeout=500,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert not processes(folder), "left running"
    assert "iteration 2: " in done.stdout
