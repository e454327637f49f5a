"""Tests that `vlagents-ray plan` prints the plan, checks it, and writes a file for `serve`."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import our_apps, policy_application, read_deployment
from vlagents_ray_fleet.command import plan_command
from vlagents_ray_fleet.fleet_file import read_fleet
from vlagents_ray_fleet.registry import PLAN

ROOT = Path(__file__).parents[3]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return Path(shutil.copy(ROOT / "examples" / "fleet.yaml", tmp_path))


def edited(file: Path, old: str, new: str) -> Path:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return file


def test_the_plan_is_a_table_and_its_check_another_one(file: Path) -> None:
    done = CliRunner().invoke(app, ["plan", str(file), "--check", "--seconds", "20"])
    assert done.exit_code == 0, done.output
    assert "of 4 GPUs" in done.output
    assert "12 of 12" in done.output
    assert "assumed: a batch on a fraction f of a GPU takes 1/f" in done.output
    assert PLAN.target == "vlagents_ray_fleet.command:plan_command"
    assert plan_command.__doc__


def test_the_plan_as_json_has_the_simulation_beside_the_prediction(file: Path) -> None:
    done = CliRunner().invoke(app, ["plan", str(file), "--json", "--check", "--seconds", "10"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["complete"] is True
    assert {model["model"] for model in document["models"]} == {"pi0", "planner"}
    for group in document["check"]["groups"]:
        assert abs(group["share"] - group["predicted_share"]) <= 0.03


def test_the_deployment_file_is_one_that_serve_takes(file: Path, tmp_path: Path) -> None:
    written = tmp_path / "served.yaml"
    done = CliRunner().invoke(app, ["plan", str(file), "--json", "--out", str(written)])
    assert done.exit_code == 0, done.output
    models = {model["model"]: model for model in json.loads(done.stdout)["models"]}
    config = read_deployment(str(written))
    assert {application.route_prefix for application in our_apps(config)} == {"/pi0", "/planner"}
    for name, model in models.items():
        args = ServerArgs(**policy_application(str(written), name).args)
        assert args.replicas == model["replicas"]
        assert args.batch.max_size == model["batch_size"]
        assert args.resources.num_gpus == model["gpu_fraction"]


def test_the_settings_of_a_model_are_those_of_its_deployment_file(
    file: Path, tmp_path: Path
) -> None:
    shutil.copy(ROOT / "deployments" / "noop.yaml", tmp_path)
    text = file.read_text()
    file.write_text(text.replace("policy: noop", "deployment: noop.yaml", 1))
    written = tmp_path / "served.yaml"
    done = CliRunner().invoke(app, ["plan", str(file), "--out", str(written)])
    assert done.exit_code == 0, done.output
    original = policy_application(str(tmp_path / "noop.yaml")).args
    kept = policy_application(str(written), "pi0").args
    assert kept["policy"] == original["policy"]
    assert kept.get("config") == original.get("config")


def test_too_few_gpus_are_an_exit_status_and_a_sentence_with_the_missing_ones(file: Path) -> None:
    edited(file, "count: 12", "count: 900")
    done = CliRunner().invoke(app, ["plan", str(file)])
    assert done.exit_code == 1
    assert "4 GPUs serve " in done.stderr
    assert " of 904 robots in time; all robots need " in done.stderr


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rows: 50", "row: 50", "there is no such setting; expected one of .*did you mean 'rows'"),
        ("hz: 10 ", "hz: 0 ", r"robots\.arms\.hz: expected greater than 0, got 0"),
        ("count: 12", "count: many", "robots.arms.count: expected a valid integer, got 'many'"),
        ("pi0: {rows: 25}", "pi: {rows: 25}", "expected only .*, got 'pi'; did you mean 'pi0'"),
        ("count: 4\n  memory_gb: 80", "count: 4", "gpus.memory_gb: is missing; add"),
        ("memory_gb: 18", "memory_gb: 180", "expected at most the 80 of a GPU, got 180"),
        ("fixed_ms: 29.3, ", "", "expected fixed_ms with row_ms, got"),
        ("row_ms: 8.06", "row_ms: 8.06, table: {1: 3}", "expected one of .* keep one"),
        ("fixed_ms: 29.3, row_ms: 8.06", "fixed_ms: 0, row_ms: 0", "expected a duration"),
        ("fixed_ms: 29.3, row_ms: 8.06", "url: file:///etc/x", "costs.url: expected the metadata"),
        ("      planner: {hz: 1, age_ms: 3000}", "     ", "got the unused"),
        ("policy: noop  #", "policy: noop\n    deployment: x.yaml  #", "got both; keep one"),
    ],
)
def test_a_wrong_file_is_a_message_with_the_cure(
    file: Path, old: str, new: str, message: str
) -> None:
    edited(file, old, new)
    with pytest.raises(ConfigError, match=f"(?s){message}"):
        [model.costs.curve() for model in read_fleet(file).models.values()]
    done = CliRunner().invoke(app, ["plan", str(file)])
    assert done.exit_code == 2
    assert "Traceback" not in done.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.yaml"], "does not exist"),
        (["fleet.txt"], "file of a fleet: expected a .yaml file"),
        (["FILE", "--out", "served.txt"], "--out: expected a YAML file"),
    ],
)
def test_mistakes_are_told_in_a_line(
    file: Path, words: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(file.parent)
    done = CliRunner().invoke(
        app, ["plan", *(str(file) if word == "FILE" else word for word in words)]
    )
    assert done.exit_code == 2, done.output
    assert message in done.stderr


def test_a_list_is_no_fleet(file: Path) -> None:
    file.write_text("- robots\n")
    message = "expected a mapping with `models`, `robots` and `gpus`, got list"
    with pytest.raises(ConfigError, match=message):
        read_fleet(file)


def test_a_model_without_a_policy_has_no_deployment_file(file: Path, tmp_path: Path) -> None:
    document = yaml.safe_load(file.read_text())
    del document["models"]["planner"]["policy"]
    file.write_text(yaml.safe_dump(document))
    assert CliRunner().invoke(app, ["plan", str(file)]).exit_code == 0
    done = CliRunner().invoke(app, ["plan", str(file), "--out", str(tmp_path / "served.yaml")])
    assert done.exit_code == 2
    assert "models.planner: expected `deployment` or `policy`" in done.stderr
