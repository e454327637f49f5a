"""A user's modules are found in the working directory of the command, and mistyped settings are
reported before anything starts.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vlagents_ray.cli import policies
from vlagents_ray.cli.main import app
from vlagents_ray.client.transports import base
from vlagents_ray.registry import POLICIES, entries
from vlagents_ray.serve.ports import free_port

ROOT = Path(__file__).parents[2]
POLICY = """
from pydantic import BaseModel

from vlagents_ray import Act, Agent

class Reach(Agent):
    def __init__(self, gain=0.5):
        self.gain = gain

    def act(self, obs):
        return Act(None)

class Loaded(Agent):
    class Config(BaseModel):
        checkpoint: str

    def act(self, obs):
        return Act(None)
"""
ENV = """
from vlagents_ray.envs.tabletop import Tabletop

class MyEnv(Tabletop):
    pass
"""
RUNS: dict[str, dict[str, object]] = {
    "typo": {"worker": 2},
    "low": {"workers": -1},
    "listed": {"suites": [{"envs": ["tabletop"], "episods": 3}]},
}
# The code of the console script. The first entry of its `sys.path` is the script's folder, not the
# working directory.
SCRIPT = """
import sys
sys.path[0] = sys.argv.pop(1)
from vlagents_ray.cli import main
main()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "my_policies.py").write_text(POLICY)
    (tmp_path / "my_envs.py").write_text(ENV)
    for name, wrong in RUNS.items():
        run = {"policies": [{"source": "scripted"}], "suites": [{"envs": ["tabletop"]}]} | wrong
        (tmp_path / f"{name}.yaml").write_text(json.dumps(run))
    return tmp_path


def said_by_a_process(folder: Path, *words: str, **variables: str) -> str:
    """Return the output of a command that is started in `folder` and fails before anything
    starts.
    """
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(ROOT), *words],
        cwd=folder,
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2, done.stdout + done.stderr
    return done.stderr


def said_by(*words: str) -> str:
    """Return the output of the command in this process."""
    done = CliRunner().invoke(app, words, env={"COLUMNS": "40"})
    assert done.exit_code == 2, done.output
    return done.stderr


EVAL = ("--out", "runs/x", "--policy")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (
            ("serve", "my_policies:Reach", "--set", "gian=1"),
            "it accepts .'gain'.; did you mean 'gain'",
        ),
        (
            ("serve", "my_policies:Reech"),
            "module 'my_policies' has no class 'Reech'; did you mean 'Reach'",
        ),
        (("serve", "my_polices:Reach"), "did you mean 'my_policies'"),
        (("serve", "scriptd"), "did you mean 'scripted'"),
        (
            ("serve", "noop", "--set", "chnk=3"),
            "chnk: there is no such setting; .*did you mean 'chunk'",
        ),
        (
            ("serve", "noop", "--serve-set", "batch.maxsize=3"),
            "batch.maxsize: there is no such setting.*did you mean 'max_size'",
        ),
        (("serve", "noop", "--serve-set", "wrapers=[arro]"), "did you mean 'wrappers'"),
        (
            ("eval", "my_envs:MyEnv", *EVAL, "my_policies:Reach", "--set", "gian=1"),
            "did you mean 'gain'",
        ),
        (
            ("eval", "my_envs:MyEnv", *EVAL, "my_policies:Reach", "--env-set", "widht=9"),
            "did you mean 'width'",
        ),
        (
            ("eval", "tabletop/lft", *EVAL, "scripted"),
            "tabletop: expected a task of .*, got 'lft'.*did you mean 'lift'",
        ),
        (("eval", "libero/libero_spatail/1", *EVAL, "scripted"), "did you mean 'libero_spatial'"),
        (
            ("eval", "libero/libero_spatial/12", *EVAL, "scripted"),
            "expected a task from 0 to 9, or a name, got '12'",
        ),
        (
            ("eval", "tabletop", *EVAL, "scripted", "--worker-gpus", "0.5"),
            "got 0.5 for a worker",
        ),
        (
            ("eval", "tabletop", *EVAL, "scripted", "--video", "alll"),
            "video: expected 'none', 'failures' or 'all', got 'alll'; did you mean 'all'",
        ),
        (
            ("eval", "my_policies:Reach", *EVAL, "scripted"),
            "my_policies:Reach': expected an EvalEnv, got another class; name an environment",
        ),
        (
            ("serve", "runs/act/last"),
            "expected a policy or a deployment file, .*lerobot.yaml --set checkpoint=runs/act/last",
        ),
        (
            ("eval", "tabletop", *EVAL, "./typ.yaml"),
            "typ.yaml does not exist; did you mean 'typo.yaml'",
        ),
        (
            ("eval", "tabletop", *EVAL, "deployments/act.yaml"),
            "deployments/act.yaml does not exist; a checkout has deployments/",
        ),
        (
            ("eval", "tabletop", "--policy", "scripted", "--resume"),
            "Error: --resume: expected --out, the folder of the results to continue",
        ),
        (
            ("eval", "tabletop", "--out", "runs/x"),
            "Error: expected --policy, got none; add it, or give a plan",
        ),
        (("eval", "absent.yaml"), "absent.yaml does not exist"),
        (
            ("eval", "typo.yaml"),
            "worker: expected a mapping with some of .'cpus', .*, got 2; did you mean 'workers'",
        ),
        (("eval", "low.yaml"), "workers: expected greater than or equal to 0, got -1"),
        (
            ("eval", "listed.yaml"),
            "suites.0.episods: there is no such setting; .*did you mean 'episodes'",
        ),
        (
            ("serve", "my_policies:Loaded"),
            "policy Loaded: checkpoint: is missing; add --set checkpoint=…",
        ),
        (
            ("serve", "my_policies:Reach", "--set", "gain"),
            r"expected KEY=VALUE, \+KEY=VALUE or ~KEY, as in batch.max_size=8, got 'gain'",
        ),
    ],
)
def test_what_is_wrong_is_said_at_once_in_one_line_and_with_what_was_meant(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], wanted: str
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    for name in ("my_policies", "my_envs"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    said = said_by(*words)
    assert re.search(wanted, said)
    assert said.count("\n") == 1
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("serve", "lerobot", "--set", "checkpoint=weights"),
        ("eval", "tabletop", *EVAL, "lerobot", "--set", "checkpoint=weights"),
        (
            "eval",
            "tabletop",
            *EVAL,
            "lerobot",
            "--set",
            "checkpoint=weights/{step}",
            "--watch",
            "weights",
        ),
    ],
)
def test_a_family_whose_packages_are_missing_is_said_before_anything_starts_or_is_waited_for(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setitem(
        POLICIES, "lerobot", replace(entries("policies")["lerobot"], needs=("no_such_package",))
    )
    monkeypatch.setattr(
        "vlagents_ray.serve.launch.server.running_server",
        lambda *_, **__: pytest.fail("a server was started"),
    )
    done = CliRunner().invoke(app, words)
    assert (
        "policy 'lerobot': not in this environment (no_such_package): `vlagents-ray venv create "
        in done.stderr
    )
    assert done.exit_code == 1
    assert not (folder / "runs").exists()


def test_a_module_that_is_nowhere_is_looked_for_in_the_working_directory_which_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    said = said_by("serve", "elsewhere:Policy")
    assert (
        f"no module 'elsewhere' is installed, or is in the working directory {folder}; go to "
        "the module's folder"
    ) in said


@pytest.mark.slow
def test_modules_are_found_in_the_folder_where_a_command_is_typed_unless_python_is_kept_from_it(
    folder: Path,
) -> None:
    words = ("my_policies:Reech", "--env", "tabletop")
    assert "module 'my_policies' has no class 'Reech'" in said_by_a_process(
        folder, "serve", words[0]
    )
    if sys.version_info >= (3, 11):  # Python 3.10 ignores PYTHONSAFEPATH
        assert "no module 'my_policies'" in said_by_a_process(
            folder, "robot", *words, PYTHONSAFEPATH="1"
        )


def test_a_url_where_nothing_answers_is_told_once_and_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(base, "_SILENT_S", 0.0)
    monkeypatch.setattr(policies, "_STARTING_S", 0.2)
    url = f"http://127.0.0.1:{free_port()}"
    done = CliRunner().invoke(app, ["eval", "tabletop", "--out", "runs/x", "--policy", url])
    assert done.exit_code == 1
    [warned] = caplog.messages
    assert warned.startswith(f"{url}: not ready; trying again for up to 0 s (")
    assert "is it running?" in warned
    assert done.stderr.startswith(f"Error: PolicyUnavailable: {url}: not ready within 0.2 s")


def test_without_out_the_results_get_a_new_folder_with_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["eval", "tabletop/lift", "--policy", "scripted", "--dry-run"])
    assert done.exit_code == 0, done.output
    assert re.search(r"finished in runs/tabletop_lift-\d{8}-\d{6},", done.stdout)
