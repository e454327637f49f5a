"""Each command that reads a settings file finds it by name, and changes its settings with the same
options.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import train
import typer
import yaml
from typer.testing import CliRunner

from benchmarks import policy as policy_benchmark
from vlagents_ray.cli import evaluation
from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import EvalConfig, Results, replay
from vlagents_ray.serve.launch import deployment_file
from vlagents_ray_learn.open_loop import comparison

SETTINGS = {"gain": 1, "nested": {"a": 1, "b": 2}, "entries": [{"x": 1}]}
DEPLOYMENT = {
    "applications": [
        {
            "name": "noop",
            "route_prefix": "/",
            "import_path": deployment_file.IMPORT_PATH,
            "args": {"policy": "noop", "config": SETTINGS},
        }
    ]
}
RUNS = {
    "policies": [{"name": "mine", "source": "noop", "config": SETTINGS}],
    "suites": [{"envs": ["tabletop"]}],
}


class Captured(Exception):
    """Raised with the settings with which a command would continue."""

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__()
        self.settings = settings


@dataclass(frozen=True)
class Row:
    """A command that reads a settings file."""

    words: list[str]  # arguments; {file} is the file
    document: dict[str, Any]  # the content of the file
    prefix: str = ""  # prefix of `SETTINGS` in the arguments of --set
    command: typer.Typer = app


def _typer(main: Callable[..., None]) -> typer.Typer:
    """Return the command of a script that calls `typer.run(main)`."""
    script = typer.Typer()
    script.command()(main)
    return script


IN_RUNS = "policies.0.config."
ROWS = {
    "serve": Row(["serve", "{file}"], DEPLOYMENT),
    "eval": Row(["eval", "{file}"], RUNS, IN_RUNS),
    "eval --policy": Row(["eval", "tabletop", "--out", "out", "--policy", "{file}"], DEPLOYMENT),
    "replay": Row(["replay", "results", "--policy", "{file}"], DEPLOYMENT),
    "open-loop": Row(["open-loop", "dataset", "--policy", "{file}"], DEPLOYMENT),
    "slurm eval": Row(["slurm", "eval", "{file}"], RUNS, IN_RUNS),
    "slurm serve": Row(["slurm", "serve", "{file}"], DEPLOYMENT),
    "examples/learn/train.py": Row(["{file}"], SETTINGS, command=_typer(train.main)),
    "benchmarks/policy.py": Row(["{file}"], DEPLOYMENT, command=_typer(policy_benchmark.main)),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a working directory in which commands end at the point where they would use the
    settings.
    """

    def of_deployment(_: Any, config: dict[str, Any], **__: Any) -> None:
        raise Captured(config)

    def of_runs(config: EvalConfig, *_: Any, **__: Any) -> None:
        raise Captured(config.policies[0].config)

    def of_training(settings: dict[str, Any]) -> None:
        settings.pop("out", None)
        raise Captured(settings)

    class Recorded:
        def config(self, _: Path, *, policy: dict[str, Any]) -> None:
            raise Captured(policy["config"])

    monkeypatch.setattr(deployment_file, "_require_policy", of_deployment)
    monkeypatch.setattr(evaluation, "run_evaluation", of_runs)
    monkeypatch.setattr("vlagents_ray.cli.policies.resolve_policies", of_runs)
    monkeypatch.setattr(train.LearnPlan, "model_validate", of_training)
    monkeypatch.setattr(Results, "load", lambda _: None)
    monkeypatch.setattr(replay, "find", lambda *_: Recorded())
    monkeypatch.setattr(comparison, "open_datasets", lambda _: [])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()
    return tmp_path


def ended(row: Row, *options: str, file: str = "conf/nightly.yaml") -> Any:
    """Run a command with its file in `conf`."""
    Path("conf/nightly.yaml").write_text(yaml.safe_dump(row.document))
    words = [word.replace("{file}", file) for word in row.words]
    return CliRunner().invoke(row.command, [*words, *options])


def captured(row: Row, *options: str, file: str = "conf/nightly.yaml") -> dict[str, Any]:
    """Return the settings with which a command would continue."""
    done = ended(row, *options, file=file)
    assert isinstance(done.exception, Captured), done.output
    return done.exception.settings


def changes(row: Row, *texts: str) -> list[str]:
    """Return the options that change the settings. A sign comes before the prefix."""
    options = []
    for text in texts:
        sign = text[0] if text[0] in "+~" else ""
        options += ["--set", f"{sign}{row.prefix}{text.removeprefix(sign)}"]
    return options


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_set_changes_adds_and_removes_what_the_file_has(row: Row) -> None:
    options = changes(row, "gain=2", "entries.0.x=5", "+new=7", "+entries.1.x=6", "~nested.a")
    assert captured(row, *options) == {
        "gain": 2,
        "nested": {"b": 2},
        "entries": [{"x": 5}, {"x": 6}],
        "new": 7,
    }


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("name", ["nightly", "nightly.yaml"])
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_a_file_is_found_by_its_name(row: Row, name: str) -> None:
    options = ["--config-dir", "conf", *changes(row, "gain=2")]
    assert captured(row, *options, file=name) == SETTINGS | {"gain": 2}


WRONG = {
    "new, but it is there": ("+gain=2", "expected a new key, got an existing key with the value 1"),
    "removed, but not there": ("~gian", "did you mean 'gain'?"),
    "an entry that is not there": ("entries.7.x=1", "0 to 0, got 7; append an entry"),
    "not a change": ("gain", "expected KEY=VALUE, +KEY=VALUE or ~KEY"),
}


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_a_wrong_change_is_an_error_with_its_cure(row: Row, text: str, message: str) -> None:
    done = ended(row, *changes(row, text))
    assert done.exit_code == 2
    assert message in done.stderr


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_a_name_that_is_not_there_is_an_error_with_the_most_similar_one(row: Row) -> None:
    done = ended(row, "--config-dir", "conf", file="nihgtly")
    assert done.exit_code == 2
    assert "'nihgtly': expected a file in conf, one of ['nightly']" in done.stderr
    assert "did you mean 'nightly'?" in done.stderr


SERVED = ["serve", "open-loop", "slurm serve", "benchmarks/policy.py"]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("row", [ROWS[name] for name in SERVED], ids=SERVED)
def test_serve_set_changes_the_server_of_a_file(row: Row, monkeypatch: pytest.MonkeyPatch) -> None:
    def of_server(args: Any, *_: Any, **__: Any) -> None:
        raise Captured(args.model_dump())

    monkeypatch.setattr(deployment_file, "_require_policy", of_server)
    args = captured(row, "--serve-set", "batch.max_size=3", "--serve-set", "+wrappers=[arro]")
    assert args["batch"]["max_size"] == 3
    assert args["wrappers"] == ["arro"]
    assert args["config"] == SETTINGS

    wrong = ended(row, "--serve-set", "batch.maxsize=3")
    assert wrong.exit_code == 2
    assert "did you mean 'max_size'" in wrong.stderr

    other = ended(row, "--serve-set", "config.gain=2")
    assert "give the policy's settings with --set" in other.stderr


def test_a_setting_of_user_config_is_changed(folder: Path) -> None:
    app_of_file = DEPLOYMENT["applications"][0] | {
        "deployments": [{"name": "Policy", "user_config": {"gain": 3}, "max_ongoing_requests": 5}]
    }
    row = Row(["serve", "{file}"], {"applications": [app_of_file]})
    assert captured(row)["gain"] == 3
    assert captured(row, "--set", "gain=4")["gain"] == 4
    file = str(folder / "conf/nightly.yaml")
    with pytest.raises(Captured) as changed:
        deployment_file.read_deployment(file)
    assert changed.value.settings["gain"] == 3


@pytest.mark.usefixtures("folder")
def test_a_file_of_several_policies_is_not_changed() -> None:
    [first] = DEPLOYMENT["applications"]
    second = first | {"name": "other", "route_prefix": "/other"}
    row = Row(["serve", "{file}"], {"applications": [first, second]})
    done = ended(row, "--set", "gain=2")
    assert done.exit_code == 2
    assert "expected a file with one policy, got ['noop', 'other']" in done.stderr

    one_of_them = Row(["tune", "{file}", "--app", "other"], row.document)
    assert ended(one_of_them, "--set", "gain=2").exception is not None


@pytest.mark.usefixtures("folder")
def test_a_setting_of_a_policys_file_is_removed_only_in_the_file() -> None:
    done = ended(ROWS["eval --policy"], "--set", "~gain")
    assert done.exit_code == 2
    assert "expected values for the settings of conf/nightly.yaml, got ['gain'] removed" in (
        done.stderr
    )


@pytest.mark.usefixtures("folder")
def test_the_deployment_files_of_a_file_of_runs_are_found_too() -> None:
    Path("conf/robot.yaml").write_text(yaml.safe_dump(DEPLOYMENT))
    runs = RUNS | {"policies": [{"name": "mine", "source": "robot.yaml", "config": {"gain": 9}}]}
    row = Row(["eval", "{file}"], runs)
    assert captured(row, "--config-dir", "conf", file="nightly") == {"gain": 9}

    absent = RUNS | {"policies": [{"source": "robto.yaml"}]}
    done = ended(Row(["eval", "{file}"], absent), "--config-dir", "conf", file="nightly")
    assert "did you mean 'robot.yaml'" in done.stderr


def _commands(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each command with its name."""
    inner = getattr(command, "commands", {})
    if not inner:
        yield name.strip(), command
    for inside, subcommand in inner.items():
        yield from _commands(subcommand, f"{name} {inside}")


def _options(command: Any) -> set[str]:
    return {option for parameter in command.params for option in parameter.opts}


def test_each_command_that_reads_a_file_is_in_the_table() -> None:
    with_options, with_files = set(), set()
    for name, command in _commands(typer.main.get_command(app)):
        if "--config-dir" in _options(command):
            assert "--set" in _options(command)
            with_options.add(name)
        helps = [getattr(parameter, "help", None) or "" for parameter in command.params]
        reads_file = any("(.yaml)" in text or "deployment file" in text.lower() for text in helps)
        if reads_file:
            with_files.add(name)
    # `slurm` passes on the options of `eval` and `serve`.
    names = {name.removesuffix(" --policy") for name in ROWS if "/" not in name}
    assert with_options == {name for name in names if not name.startswith("slurm")}
    assert with_files == with_options
