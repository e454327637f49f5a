"""`vlagents-ray tune` writes a deployment file with the figures that it was chosen by."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from vlagents_ray.bench.tuning import picture
from vlagents_ray.cli.evaluation.command import read_run
from vlagents_ray.cli.main import app
from vlagents_ray.errors import MissingDependency
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.serve.launch.deployment_file import server_args

FILE = """\
# What drives my robot
applications:
  - name: mine  # a name
    route_prefix: /
    import_path: vlagents_ray.serve.app:build
    args:
      policy: tuned_policies:Tunable
      batch: {max_size: 2}
"""
QUICK = ["--seconds", "0.1", "--max-batch", "2"]


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1] / "support"))
    made = tmp_path / "mine.yaml"
    made.write_text(FILE)
    return made


def test_the_tuned_file_has_the_settings_the_figures_and_the_old_lines(file: Path) -> None:
    done = CliRunner().invoke(app, ["tune", str(file), *QUICK])
    assert done.exit_code == 0, done.output
    written = file.with_name("mine.tuned.yaml")
    assert f"wrote {written}" in done.output
    args = server_args(str(written))
    assert args.config["compile"] is True
    assert args.config["batch_sizes"][-1] == args.batch.max_size
    text = written.read_text()
    assert text.startswith("# Tuned on ")
    for line in ("# chosen: compile: true, ", "# the file as it was: own settings, 2 sessions: ", "actions off by"):
        assert line in text
    assert "# What drives my robot\n" in text
    assert "  - name: mine  # a name\n" in text
    assert file.read_text() == FILE
    assert file.with_name("mine.tuned.svg").read_text().startswith("<?xml")


def test_without_matplotlib_there_is_no_picture(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(file: Path | None) -> None:
        raise MissingDependency("'matplotlib' is not installed")

    monkeypatch.setattr(picture, "check_plot_file", missing)
    words = ["tune", str(file), *QUICK, "--for", "robots", "--p99-ms", "60000", "--out", str(file.parent / "out.yaml")]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "no picture of latency against throughput: 'matplotlib'" in done.output
    assert (file.parent / "out.yaml").is_file()


def test_a_goal_that_nothing_reaches_writes_no_file(file: Path) -> None:
    done = CliRunner().invoke(app, ["tune", str(file), *QUICK, "--for", "robots", "--p99-ms", "0.000001"])
    assert done.exit_code == 1
    assert "the shortest p99 of a round trip was" in done.stderr
    assert not file.with_name("mine.tuned.yaml").exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["noop"], "deployment file"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["nowhere.yaml", "--for", "robots"], "--p99-ms"),
        (["nowhere.yaml", "--p99-ms", "60"], "--for robots"),
        (["FILE", "--state", "joints=some"], "joints"),
        (["FILE", "--app", "yours"], "mine"),
        (["FILE", "--frames", "."], "trajectory"),
    ],
)
def test_mistakes_are_told_in_a_line(file: Path, words: list[str], text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(file.parent)
    done = CliRunner().invoke(app, ["tune", *(str(file) if word == "FILE" else word for word in words)])
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output


@pytest.mark.ray
@pytest.mark.server
def test_a_file_of_runs_gets_workers_and_environments(tmp_path: Path) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text(
        "# mine\npolicies: [{source: scripted}]\nsuites: [{envs: [tabletop], env_options: {max_steps: 5}}]\n"
    )
    done = CliRunner().invoke(app, ["tune", str(file), "--max-workers", "1", "--minutes", "0.2"])
    assert done.exit_code == 0, done.output
    text = file.with_name("runs.tuned.yaml").read_text()
    assert text.startswith("# Tuned on ")
    assert "# chosen: 1 worker with " in text
    assert "# mine\npolicies: [{source: scripted}]\n" in text
    assert EvalConfig.model_validate(read_run(file.with_name("runs.tuned.yaml"))).workers == 1


def test_options_of_deployment_files_are_refused_for_a_file_of_runs(tmp_path: Path) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text("policies: [{source: noop}]\nsuites: [{envs: [tabletop]}]\n")
    done = CliRunner().invoke(app, ["tune", str(file), "--dtypes", "int8"])
    assert done.exit_code == 2
    assert "are of deployment files" in done.output
