"""Each number that a user can set has bounds, and a value outside them is rejected at once."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from pydantic import BaseModel
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.serve.config.deployment import ServerArgs

SLIPS = ("1000000000000000000", "-1", "nan", "inf", "-inf", "text", "")
COMMANDS: Any = typer.main.get_command(app)


def numeric_options() -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """Yield (command, option, its parameter) for each numeric option of each command."""
    yield from _numeric(COMMANDS, ())


def _numeric(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    for name, below in getattr(command, "commands", {}).items():
        yield from _numeric(below, (*path, name))
    for parameter in command.params:
        if parameter.type_descriptor.annotation in (int, float):
            yield path, parameter.opts[0], parameter


OPTIONS = list(numeric_options())


def words_before(command: Any) -> list[str]:
    """Return a value for each required argument of a command, so that only the tested number is
    wrong.
    """
    words: list[str] = []
    for parameter in command.params:
        if parameter.required:
            words += ["x"] if parameter.param_type_name == "argument" else [parameter.opts[0], "x"]
    return words


def command_at(path: tuple[str, ...]) -> Any:
    command = COMMANDS
    for name in path:
        command = command.commands[name]
    return command


def test_the_numeric_options_are_found() -> None:
    names = {(path[-1], option) for path, option, _ in OPTIONS}
    assert {
        ("eval", "--episodes"),
        ("create", "--days"),
        ("serve", "--port"),
    } <= names
    assert len(names) >= 20


@pytest.mark.parametrize(
    ("path", "option", "parameter"), OPTIONS, ids=lambda one: str(one).strip("<>")[:40]
)
def test_a_number_out_of_its_bounds_is_answered_at_once(
    path: tuple[str, ...],
    option: str,
    parameter: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for slip in SLIPS:
        began = time.process_time()
        done = CliRunner().invoke(app, [*path, *words_before(command_at(path)), f"{option}={slip}"])
        assert done.exit_code == 2, (slip, done.output)
        assert option in done.output, (slip, done.output)
        assert "Traceback" not in done.output
        assert isinstance(done.exception, SystemExit), (slip, done.exception)
        assert time.process_time() - began < 10, slip
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ["eval", "tabletop", "--policy", "scripted", "--out", "out", "--end-at", "nan"],
        ["eval", "tabletop", "--policy", "scripted", "--out", "out", "--end-at", "1e300"],
        ["open-loop", "dataset", "--policy", "noop", "--episodes", "0-99999999999999"],
        ["open-loop", "dataset", "--policy", "noop", "--episodes", "9-0"],
        ["eval", "tabletop", "--policy", "noop", "--out", "out", "--live-at", "127.0.0.1:99999"],
    ],
    ids=" ".join,
)
def test_a_number_inside_a_text_has_bounds(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dataset" / "meta").mkdir(parents=True)
    (tmp_path / "dataset" / "meta" / "info.json").write_text("{}")
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2, done.output
    assert words[-2] in done.output
    assert not (tmp_path / "out").exists()


def unbounded(schema: Any, where: str = "") -> Iterator[str]:
    """Yield the places of numbers without an upper bound in a JSON schema."""
    if isinstance(schema, list):
        for part in schema:
            yield from unbounded(part, where)
    elif isinstance(schema, dict):
        if (
            schema.get("type") in ("integer", "number")
            and not {"maximum", "exclusiveMaximum"} & schema.keys()
        ):
            yield where
        for name, part in schema.items():
            inner = name in ("$defs", "properties", "anyOf", "items", "additionalProperties")
            yield from unbounded(part, where if inner else f"{where}.{name}")


@pytest.mark.parametrize("model", [EvalConfig, ServerArgs])
def test_every_number_in_a_file_has_an_upper_bound(model: type[BaseModel]) -> None:
    places = set(unbounded(model.model_json_schema()))
    assert places - {".ClockConfig.neutral"} == set()  # an action, in the robot's own units


def test_a_sweep_or_a_plan_of_too_many_steps_is_not_listed() -> None:
    steps = {"first": 0, "last": 10**12, "every": 1}
    began = time.process_time()
    with pytest.raises(ValueError, match="expected at most 10000 steps"):
        EvalConfig(
            policies=[{"source": "noop", "steps": steps}], suites=[{"envs": ["tabletop"]}], out="x"
        )  # type: ignore[list-item,arg-type]
    assert time.process_time() - began < 5
