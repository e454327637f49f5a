"""`vlagents-ray eval` in its own process: without Ray, with checkpoints, and under a debugger."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import yaml
from eval_fakes import LINE, PYTHONPATH
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.cli.policies import with_full_passes
from vlagents_ray.evaluate import Results
from vlagents_ray.serve.config.deployment import BatchArgs
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, Deployment

POLICY = """
import os
from pathlib import Path
import numpy as np
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.interface import Act, Agent

class Stepped(Agent):
    def __init__(self, checkpoint, checkpoint_step=None):
        self.file = Path(checkpoint.replace("{step}", str(checkpoint_step)))

    @property
    def contract(self):
        return Contract(state={"position": StateSpec(1)}, action=ActionSpec(dim=1))

    def initialize(self):
        self.length = float(self.file.read_text())

    def reset(self, obs, instruction, *, seed=None, **kwargs):
        self.noise = np.random.default_rng(seed)
        return {}

    def act(self, obs):
        if "STOP" in os.environ:
            breakpoint()
        return Act(-np.sign(obs.state["position"]) * self.length * self.noise.uniform(0.9, 1.0, 1))
"""
# Simulate an environment without Ray, in which each import of it fails.
WITHOUT_RAY = "import sys; sys.modules['ray'] = None; from vlagents_ray.cli import main; main()"
POISON = [sys.executable, "-c", WITHOUT_RAY]


def deployment(**args: object) -> dict[str, object]:
    return {
        "applications": [
            {"name": "a", "import_path": IMPORT_PATH, "args": {"policy": "stepped:Stepped", **args}}
        ]
    }


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working directory, with a policy and two of its checkpoints."""
    (tmp_path / "stepped.py").write_text(POLICY)
    for step, length in ((1, 0.5), (2, 1.0)):
        (tmp_path / f"w-{step}.txt").write_text(str(length))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", PYTHONPATH)
    # Ray sets PYTHONBREAKPOINT in a process that connects.
    for name in ("RAY_ADDRESS", "PYTHONBREAKPOINT"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.mark.slow
def test_named_policies_deployment_files_and_checkpoints_are_played_without_ray(
    folder: Path,
) -> None:
    own = deployment(config={"checkpoint": "w-2.txt"})
    (folder / "own.yaml").write_text(yaml.safe_dump(own))
    swept = {
        "name": "swept",
        "source": "stepped:Stepped",
        "config": {"checkpoint": "w-{step}.txt"},
        "steps": [1, 2],
    }
    late = {"name": "late", "source": "own.yaml"}
    still = {"name": "still", "source": "noop", "config": {"action_dim": 1}}
    plan = {
        "policies": [swept, late, still],
        "suites": [{"envs": [LINE], "episodes": 4}],
        "video": "none",
    }
    (folder / "runs.yaml").write_text(yaml.safe_dump(plan))
    done = subprocess.run(
        [*POISON, "eval", "runs.yaml"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=folder,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "a short evaluation, in this process without Ray (--workers 1 runs" in done.stdout
    cases = {case.policy_id: case for case in Results.load(folder / "runs" / "runs").cases}
    actions = {
        name: [one.result.actions_sha256 for one in case.episodes] for name, case in cases.items()
    }
    assert actions["swept@2"] == actions["late"]
    assert len({tuple(one) for one in actions.values()}) == 3
    assert {one.result.checkpoint for one in cases["swept@1"].episodes} == {"w-1.txt"}
    assert {one.result.transport for case in cases.values() for one in case.episodes} == {"local"}


@pytest.mark.slow
@pytest.mark.torch
def test_an_episode_beside_others_is_replayed_to_the_bit(folder: Path) -> None:
    pytest.importorskip("torch")
    checkpoint = str(Path(__file__).parents[2] / "examples/reference/checkpoint")
    policy = {
        "source": "reference",
        "config": {"checkpoint": checkpoint, "embodiment": "tabletop", "execute": 4},
    }
    options = {"width": 64, "height": 64, "cameras": ["front", "wrist"], "max_steps": 12}
    suite = {"envs": ["tabletop"], "episodes": 5, "num_envs": 3, "env_options": options}
    plan = {"policies": [policy], "suites": [suite], "video": "none", "record": "all"}
    (folder / "runs.yaml").write_text(yaml.safe_dump(plan))
    command = [*POISON, "eval", "runs.yaml", "--workers", "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr

    results = Results.load(folder / "runs" / "runs")
    assert results.policies["reference"]["passes"] == {"invariant": True, "rows": 8}
    for number in (1, 4):
        command = [*POISON, "replay", "runs/runs", f"tabletop#{number}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "actions byte for byte, and their outcomes" in done.stdout


def _batch(sessions: int, rows: int | None = None, **batch: object) -> dict[str, object]:
    args = {"batch": batch} if batch else {}
    changed = with_full_passes(
        Deployment.model_validate(deployment(**args)), sessions, rows
    ).applications[0]
    described = BatchArgs.model_validate(changed.args.get("batch", {}))
    return {"max_size": described.max_size, "invariant": described.invariant}


def test_an_evaluation_pads_its_full_batches() -> None:
    assert _batch(1) == {"max_size": 16, "invariant": False}
    assert _batch(2) == {"max_size": 8, "invariant": "auto"}
    assert _batch(9) == {"max_size": 16, "invariant": "auto"}
    assert _batch(100) == {"max_size": 16, "invariant": "auto"}
    assert _batch(100, max_size=2) == {"max_size": 2, "invariant": "auto"}
    # What the file says of it is kept.
    assert _batch(5, invariant=False) == {"max_size": 16, "invariant": False}
    assert _batch(5, invariant=True) == {"max_size": 16, "invariant": True}
    assert _batch(5, sizes=[4, 8]) == {"max_size": 8, "invariant": False}
    # A replay has the recorded number of rows.
    assert _batch(1, 8) == {"max_size": 8, "invariant": True}
    assert _batch(1, 8, sizes=[2]) == {"max_size": 8, "invariant": True}


REFUSED: Mapping[str, tuple[dict[str, object], list[str], str]] = {
    "cluster": (
        {"url": "serve://pi0"},
        [],
        "expected 1 or more, as serve://pi0 is inside a Ray cluster",
    ),
    "address": (
        {"source": "noop"},
        ["--address", "auto"],
        "expected 1 or more with --address, got 0",
    ),
    "packages": (
        {"source": "packages.yaml"},
        [],
        "as 'noop' has a runtime_env, or another import_path",
    ),
    "worker": ({"source": "noop"}, [], "a worker's runtime_env has 'pip'"),
}


@pytest.mark.parametrize("more", [[], ["--dry-run"]], ids=["run", "dry run"])
@pytest.mark.parametrize("why", REFUSED)
def test_what_only_ray_can_do_is_refused(why: str, folder: Path, more: list[str]) -> None:
    policy, words, text = REFUSED[why]
    packages = deployment(policy="noop")
    packages["applications"][0]["runtime_env"] = {"pip": ["einops"]}  # type: ignore[index]
    (folder / "packages.yaml").write_text(yaml.safe_dump(packages))
    plan = {"policies": [policy], "suites": [{"envs": [LINE]}], "workers": 0}
    if why == "worker":
        plan["worker"] = {"runtime_env": {"pip": ["einops"]}}  # type: ignore[assignment]
    (folder / "runs.yaml").write_text(yaml.safe_dump(plan))
    done = CliRunner().invoke(app, ["eval", "runs.yaml", *words, *more], env={"COLUMNS": "300"})
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert not (folder / "runs").exists()


# For each dry run, the changes of the plan, the options, and the expected number of workers.
DRY_RUNS = {
    "none": ({}, [], 0),
    "0": ({"workers": 0}, [], 0),
    "1": ({"workers": 1}, [], 1),
    "3": ({"workers": 3}, [], 3),
    "long": ({"suites": [{"envs": [LINE], "episodes": 1000}]}, [], 1),
    "packages": ({"policies": [{"source": "packages.yaml"}]}, [], 1),
    "gpu": ({"policies": [{"source": "gpu.yaml"}]}, [], 1),
    "address": ({}, ["--address", "auto"], 1),
    "url": ({"policies": [{"url": "http://127.0.0.1:9"}]}, [], 0),
}


@pytest.mark.parametrize("dry_run", DRY_RUNS)
def test_a_dry_run_names_the_workers_with_which_the_run_itself_is_played(
    dry_run: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This also holds for a policy given by name, which becomes an address in the cluster while the
    plan is resolved.
    """
    changes, words, workers = DRY_RUNS[dry_run]
    for name, more in (
        ("packages", {"runtime_env": {"pip": ["einops"]}}),
        ("gpu", {"args": {"policy": "noop", "resources": {"num_gpus": 1}}}),
    ):
        config = deployment(policy="noop")
        config["applications"][0] |= more  # type: ignore[index]
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(config))
    plan = {"policies": [{"source": "noop"}], "suites": [{"envs": [LINE], "episodes": 4}]} | changes
    (folder / "runs.yaml").write_text(yaml.safe_dump(plan))
    done = CliRunner().invoke(
        app, ["eval", "runs.yaml", "--dry-run", *words], env={"COLUMNS": "300"}
    )
    assert done.exit_code == 0, done.output
    where = {0: "in one process, without Ray", 1: "with 1 worker:", 3: "with 3 workers:"}[workers]
    assert where in done.stdout
    assert "1 case: 1 policy x 1 environment" in done.stdout
    assert not (folder / "runs").exists()


@pytest.mark.slow
def test_a_debugger_stops_in_the_policy_with_the_terminal_and_leaving_it_ends_the_command(
    folder: Path,
) -> None:
    ours, its = pty.openpty()
    words = [
        *POISON,
        "eval",
        LINE,
        "--policy",
        "stepped:Stepped",
        "--set",
        "checkpoint=w-1.txt",
        "--out",
        "out",
    ]
    with subprocess.Popen(
        words, stdin=its, stdout=its, stderr=its, env=os.environ | {"STOP": "1"}
    ) as process:
        os.close(its)
        for text, answer in ((b"(Pdb) ", b"self.length * 84\n"), (b"42.0\r\n(Pdb) ", b"q\n")):
            seen = b""
            while not seen.endswith(text):
                try:
                    seen += os.read(ours, 4096)
                except OSError as error:  # the command has ended
                    raise AssertionError(seen.decode()) from error
            os.write(ours, answer)
        assert process.wait(60) == 130
    os.close(ours)
    [case] = Results.load(folder / "out").cases
    assert case.episodes == ()
