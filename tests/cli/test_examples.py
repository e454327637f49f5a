"""The help of each command has examples that the command's parser accepts."""

from __future__ import annotations

import importlib.metadata
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from vlagents_ray.cli.examples import EXAMPLES
from vlagents_ray.cli.main import app
from vlagents_ray.cli.robot import command_parser, parse
from vlagents_ray.cli.typer_help import commands_of, page_of_command
from vlagents_ray_robot.check_command import command_parser as check_parser

START = "$ vlagents-ray "
# This command uses argparse, and has its own examples.
ROBOT = "robot"


def commands(command: Any, name: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield each command and its full name."""
    inner = getattr(command, "commands", {})
    if not inner:
        yield name, command
    for word, subcommand in inner.items():
        yield from commands(subcommand, (*name, word))


COMMANDS = {" ".join(name): command for name, command in commands(typer.main.get_command(app))}
WITH_EXAMPLES = sorted(COMMANDS.keys() - {ROBOT})


def examples_of(name: str) -> list[list[str]]:
    """Return the words of the examples of a command."""
    lines = (COMMANDS[name].epilog or "").splitlines()
    return [shlex.split(line.removeprefix(START)) for line in lines if line.startswith(START)]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_a_command_has_examples_that_it_accepts(name: str) -> None:
    examples = examples_of(name)
    assert examples
    for words in examples:
        own_words = name.split()
        assert words[: len(own_words)] == own_words
        COMMANDS[name].make_context(name, words[len(own_words) :])


def test_the_examples_are_lines_at_the_end_of_the_help() -> None:
    shown = CliRunner().invoke(app, ["keys", "create", "--help"], env={"COLUMNS": "120"}).output
    lines = [line.strip() for line in shown.splitlines() if line.strip()]
    expected = [f"{START}{example}" for example in EXAMPLES["keys create"]]
    assert lines[-1 - len(expected) :] == ["Examples:", *expected]


def test_the_examples_of_robot_are_accepted_and_shown() -> None:
    parser, _, _ = command_parser()
    shown = parser.format_help()
    for example in EXAMPLES[ROBOT]:
        assert f"  {START}{example}\n" in shown
        parse(shlex.split(example)[1:])


def test_no_example_is_of_a_command_that_is_gone() -> None:
    assert EXAMPLES.keys() <= COMMANDS.keys()


@pytest.mark.parametrize("name", ["eval", "serve"])
def test_all_options_of_a_long_command_are_in_groups(name: str) -> None:
    options = [param for param in COMMANDS[name].params if param.param_type_name == "option"]
    without_group = [param.name for param in options if not param.rich_help_panel]
    assert without_group in ([], ["help"])
    assert len({param.rich_help_panel for param in options if param.rich_help_panel}) >= 3


PAGES = {path: page_of_command(command, path) for path, command in commands_of(get_command(app))}
PAGES["vlagents-ray robot"] = command_parser()[0].help_page()
PAGES["vlagents-ray robot check"] = check_parser().help_page()


@pytest.mark.parametrize("path", sorted(PAGES))
def test_each_row_of_a_help_is_a_sentence_and_needs_no_second_look(path: str) -> None:
    plugins = {"Robots (--robot)", "Leaders (--teleop)"}  # these panels list names, not options
    rows = []
    for panel in PAGES[path].panels:
        if panel.title not in plugins:
            rows += panel.rows
    for row in rows:
        assert re.fullmatch(r"[A-Z-].*\.", row.about), (row.term, row.about)
        assert "default:" not in row.about, (row.term, row.about)
        assert not re.search(r"<|range|None", row.term), row.term
    assert "-h, --help" in {row.term for row in rows}


def test_commands_of_both_parsers_look_the_same() -> None:
    for path in ("vlagents-ray robot", "vlagents-ray robot check", "vlagents-ray eval"):
        lines = PAGES[path].text(100, bold=False).splitlines()
        assert lines[0].startswith(f"Usage: {path} [OPTIONS] ")
        titles = [line for line in lines[1:] if re.fullmatch(r"[A-Z][^.]*:", line)]
        assert titles[0] == "Arguments:"
        assert titles[-1] == "Examples:"
        assert "Options:" in titles
        assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("words", [["eval", "--nothing"], ["robot", "--nothing"]])
def test_errors_of_both_parsers_look_the_same(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    if words[0] == ROBOT:
        with pytest.raises(SystemExit, match="2"):
            parse(words[1:])
        shown = capsys.readouterr().err
    else:
        shown = CliRunner().invoke(app, words, prog_name="vlagents-ray").output
    usage, hint, _, error = shown.splitlines()
    assert usage.startswith(f"Usage: vlagents-ray {words[0]} [OPTIONS] ")
    assert hint == f"Try 'vlagents-ray {words[0]} --help' for help."
    assert error.startswith("Error: ")
    assert "--nothing" in error


@pytest.mark.parametrize("words", [["--version"], ["robot", "--version"]])
def test_the_version_is_printed(words: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vlagents_ray", *words], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"vlagents-ray {importlib.metadata.version('vlagents-ray')}"
