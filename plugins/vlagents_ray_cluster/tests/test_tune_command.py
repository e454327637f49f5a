"""Tests that `vlagents-ray tune` prints the settings of a file to change, and the figures by which
they were chosen.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import policy_application

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
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "support"))
    deployment_file = tmp_path / "mine.yaml"
    deployment_file.write_text(FILE)
    return deployment_file


def printed_settings(output: str) -> dict[str, Any]:
    """Return the YAML at the end of the output, after the line that names its place in the file."""
    settings: dict[str, Any] = yaml.safe_load(re.split(r"\nset .*:\n", output)[1])
    return settings


@pytest.mark.slow  # each variant is measured in a separate process
def test_the_settings_to_change_are_printed_with_the_figures(file: Path) -> None:
    done = CliRunner().invoke(app, ["tune", str(file), *QUICK])
    assert done.exit_code == 0, done.output
    assert "actions off by" in done.output
    assert "\nchosen: compile: true, " in done.output
    assert "\nthe file as it is: own settings, 2 sessions: " in done.output
    assert f"set below args of 'mine' in {file}:" in done.output

    settings = printed_settings(done.output)
    assert settings["config"]["compile"] is True
    tuned = yaml.safe_load(FILE)
    for section, values in settings.items():
        tuned["applications"][0]["args"].setdefault(section, {}).update(values)
    file.write_text(yaml.safe_dump(tuned))
    args = ServerArgs(**policy_application(str(file)).args)
    assert args.config["batch_sizes"][-1] == args.batch.max_size


@pytest.mark.slow  # each variant is measured in a separate process
def test_a_goal_that_nothing_reaches_is_an_error(file: Path) -> None:
    done = CliRunner().invoke(
        app, ["tune", str(file), *QUICK, "--for", "robots", "--p99-ms", "0.000001"]
    )
    assert done.exit_code == 1
    assert "--p99-ms: expected a p99 of at most" in done.stderr
    assert "\nset " not in done.output


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["noop"], "deployment file"),
        (["nowhere.yaml"], "nowhere.yaml"),
        (["nowhere.yaml", "--for", "robots"], "--p99-ms"),
        (["nowhere.yaml", "--p99-ms", "60"], "--for robots"),
        (["FILE", "--state-dim", "joints=some"], "joints"),
        (["FILE", "--app", "yours"], "mine"),
        (["FILE", "--frames", "."], "trajectories"),
    ],
)
def test_mistakes_are_told_in_a_line(
    file: Path, words: list[str], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    done = CliRunner().invoke(
        app, ["tune", *(str(file) if word == "FILE" else word for word in words)]
    )
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output
