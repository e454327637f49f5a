"""`vlagents-ray init`: the written files work at once, and existing files are kept."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import dialect_server
import numpy as np
import pytest
import yaml
from ray_processes import serving
from readme_blocks import ENV, Block, run
from typer.testing import CliRunner

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.cli.init import as_typed
from vlagents_ray.cli.main import app
from vlagents_ray.policies.noop import Noop

KINDS = ["policy", "env", "dialect"]


def new(kind: str, name: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["init", kind, name])
    return done.exit_code, done.output


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_skeleton_passes_its_own_test(kind: str, folder: Path) -> None:
    assert new(kind, "my_own")[0] == 0
    assert {path.name for path in folder.iterdir()} == {
        "my_own.py",
        "my_own.yaml",
        "test_my_own.py",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my_own.py"]
    done = subprocess.run(
        command, check=False, cwd=folder, env=ENV, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_next_steps_run_as_they_are_printed_and_without_pytest(kind: str, folder: Path) -> None:
    """The commands run in the environment of `make demo`, which has no pytest. Commands that serve
    are tested below.
    """
    status, printed = new(kind, "my_own")
    assert status == 0
    (folder / "absent").mkdir()
    (folder / "absent" / "pytest.py").write_text("raise ImportError('pytest is not installed')")
    environment = ENV | {"PYTHONPATH": f"{folder / 'absent'}:{ENV.get('PYTHONPATH', '')}"}
    steps = [line.partition("   ")[0] for line in printed.splitlines()[1:]]
    assert any(" test_my_own.py" in step for step in steps)
    ran = [step for step in steps if " serve " not in step and not step.startswith("curl")]
    assert len(ran) == {"policy": 2, "env": 2, "dialect": 1}[kind]
    for step in ran:
        done = subprocess.run(
            ["sh", "-c", step],
            check=False,
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, step + done.stdout + done.stderr
    assert (folder / "runs" / "my_own" / "results.db").is_file() == (kind != "dialect")


@pytest.mark.server
@pytest.mark.slow
def test_a_skeleton_of_a_plugin_passes_its_own_test_once_it_is_installed(folder: Path) -> None:
    status, printed = new("plugin", "my_plugin")
    assert (status, "pip install --editable ." in printed) == (0, True)
    plugin = folder / "my_plugin"
    environment = ENV | {"PYTHONPATH": f"{plugin}:{ENV.get('PYTHONPATH', '')}"}
    # This writes the metadata of an editable install, without a package index.
    metadata = [
        sys.executable,
        "-c",
        "import setuptools; setuptools.setup()",
        "--quiet",
        "egg_info",
    ]
    subprocess.run(metadata, check=True, cwd=plugin, capture_output=True, timeout=60)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my_plugin.py"]
    done = subprocess.run(
        command,
        check=False,
        cwd=plugin,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    listed = subprocess.run(
        ["sh", "-c", "vlagents-ray policies my_plugin && vlagents-ray my_plugin --help"],
        check=True,
        cwd=plugin,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "my_plugin: moves each joint towards zero\n  ready" in listed.stdout
    assert "Print how many calls a server's policy has answered" in listed.stdout


@pytest.mark.parametrize(("on_path", "typed"), [(True, "python"), (False, "venv/bin/python")])
def test_a_program_is_named_as_the_shell_finds_it(
    on_path: bool, typed: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = folder / "venv" / "bin" / "python"
    program.parent.mkdir(parents=True)
    program.touch(0o755)
    monkeypatch.setattr(sys, "executable", str(program.with_name("python3")))
    monkeypatch.setenv("PATH", str(program.parent) if on_path else "/usr/bin")
    assert as_typed("python") == typed
    (folder / "inner").mkdir()
    monkeypatch.chdir(folder / "inner")
    assert as_typed("python") == ("python" if on_path else str(program))


@pytest.mark.server
@pytest.mark.slow
def test_a_skeleton_of_a_policy_is_served(folder: Path) -> None:
    """The steps of an environment's skeleton, which run an evaluation, are tested above."""
    assert new("policy", "my_policy")[0] == 0
    log = folder / "log"
    with serving("my_policy.yaml", log, cwd=folder) as host, RemoteAgent(f"http://{host}") as agent:
        obs = Obs(
            {"front": np.zeros((96, 96, 3), np.uint8)}, state={"xyzrpy": np.ones(6, np.float32)}
        )
        agent.reset(obs, "lift the cup")
        assert agent.act(obs).action.shape == (4,)
        words = f"tabletop --policy http://{host} --episodes 2 --workers 0 --out runs/policy"
        run(Block("bash", 1, f"vlagents-ray eval {words}"), folder)


def test_clients_of_a_skeleton_of_a_dialect_are_answered(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert new("dialect", "my_dialect")[0] == 0
    monkeypatch.syspath_prepend(folder)
    [application] = yaml.safe_load((folder / "my_dialect.yaml").read_text())["applications"]
    with dialect_server.serving(Noop(), application["args"]["dialects"]) as (client, _):
        answer = client.post("/my_dialect", json={"q": [0, 0], "task": "lift the cup"})
        assert (answer.status_code, answer.json()) == (200, [0.0] * 7)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_there_stays_and_nothing_is_written_beside_it(kind: str, folder: Path) -> None:
    for there in ("mine.py", "test_mine.py", "mine.yaml"):
        (folder / there).write_text("years of work")
        status, said = new(kind, "mine")
        assert (status, there in said) == (2, True)
        assert [(path.name, path.read_text()) for path in folder.iterdir()] == [
            (there, "years of work")
        ]
        (folder / there).unlink()
    said = new(kind, "mine")[1]
    assert "test_mine.py" in said
    assert f"vlagents-ray {'eval' if kind == 'env' else 'serve'} mine.yaml" in said


@pytest.mark.parametrize(
    "name", ["", "My", "my-policy", "../up", "a/b", "class", "1st", "numpy", "vlagents_ray"]
)
def test_a_name_that_is_no_module_of_ones_own_is_refused(name: str, folder: Path) -> None:
    status, said = new("policy", name)
    assert (status, "NAME" in said) == (2, True)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "kind"),
    [("noop", "policy"), ("openvla", "policy"), ("live", "part of a server"), ("eval", "command")],
)
def test_a_plugin_of_a_name_that_is_registered_is_refused(
    name: str, kind: str, folder: Path
) -> None:
    """The plug-in's own test could not pass."""
    status, said = new("plugin", name)
    assert (status, f"'{name}' is already the name of a {kind}" in said) == (2, True)
    assert list(folder.iterdir()) == []
