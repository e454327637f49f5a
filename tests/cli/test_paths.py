"""Each option with a path, with each kind of wrong path: one message that names the path, and no
traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from vlagents_ray.cli.main import app

EPISODE = ["--policy", "scripted", "--episodes", "1", "--workers", "0", "--video", "none"]
# Command and option -> words; "{path}" stands for the path, and "done" for a folder with results.
COMMANDS: dict[tuple[str, str], list[str]] = {
    ("serve", "--keys"): ["noop", "--keys", "{path}"],
    ("serve", "--tls-cert"): ["noop", "--tls-cert", "{path}", "--tls-key", "absent.pem"],
    ("serve", "--tls-key"): ["noop", "--tls-key", "{path}", "--tls-cert", "absent.pem"],
    ("serve", "--tls-client-ca"): [
        "noop",
        "--tls-client-ca",
        "{path}",
        "--tls-cert",
        "absent.pem",
        "--tls-key",
        "absent.pem",
    ],
    ("serve", "--config-dir"): ["nightly", "--config-dir", "{path}"],
    ("eval", "--config-dir"): ["nightly", "--config-dir", "{path}"],
    ("eval", "--out"): ["tabletop", *EPISODE, "--out", "{path}"],
    ("demo", "--out"): ["--out", "{path}"],
    ("doctor", "--python"): ["--python", "{path}"],
    ("report", "folders"): ["{path}"],
    ("report", "--out"): ["done", "--out", "{path}"],
    ("export", "folder"): ["{path}", "--to", "csv", "--out", "x.csv"],
    ("export", "--out"): ["done", "--to", "csv", "--out", "{path}"],
    ("merge", "folders"): ["{path}", "--out", "o"],
    ("merge", "--out"): ["done", "--out", "{path}"],
    ("replay", "folder"): ["{path}", "tabletop#0"],
    ("replay", "--config-dir"): [
        "done",
        "tabletop#0",
        "--policy",
        "nightly",
        "--config-dir",
        "{path}",
    ],
    ("replay", "--out"): ["done", "tabletop#0", "--out", "{path}"],
    ("open-loop", "folder"): ["{path}", "--policy", "noop"],
    ("open-loop", "--config-dir"): ["absent", "--policy", "nightly", "--config-dir", "{path}"],
    ("open-loop", "--out"): ["absent", "--policy", "noop", "--out", "{path}"],
    ("bundle", "folder"): ["{path}", "--out", "x.zip"],
    ("bundle", "--out"): ["done", "--out", "{path}"],
    ("verify", "bundle"): ["{path}"],
    ("verify", "--out"): ["absent.zip", "--out", "{path}"],
    ("venv create", "requirements"): ["{path}"],
    ("venv create", "--out"): ["absent.txt", "--out", "{path}"],
    ("venv create", "--with"): ["r.txt", "--with", "{path}"],
    ("keys create", "--keys"): ["x", "--keys", "{path}"],
    ("keys list", "--keys"): ["--keys", "{path}"],
    ("keys revoke", "--keys"): ["x", "--keys", "{path}"],
    ("slurm eval", "--setup"): [
        "tabletop",
        *EPISODE,
        "--dry-run",
        "--out",
        "o",
        "--setup",
        "{path}",
    ],
    ("slurm serve", "--setup"): ["noop", "--dry-run", "--out", "o", "--setup", "{path}"],
    ("slurm serve", "--out"): ["noop", "--dry-run", "--out", "{path}"],
}
# A file, a path below a file, a path below a missing folder, and a read-only place.
PATHS = ["text", "text/below", "folder/absent/below", "/proc/absent"]
# Results replace a file, and --dry-run writes nothing.
USABLE = {("report", "--out", "text"), ("export", "--out", "text"), ("bundle", "--out", "text")}
USABLE |= {("slurm serve", "--out", path) for path in PATHS} | {("slurm serve", "--setup", "text")}
USABLE |= {("slurm eval", "--setup", "text")}
# These commands create a missing folder with its parents.
MADE = {
    "eval",
    "demo",
    "merge",
    "slurm eval",
    "slurm serve",
    "replay",
    "open-loop",
    "verify",
    "venv create",
}


def commands(command: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    below = getattr(command, "commands", None)
    if below is None:
        yield name, command
        return
    for key, sub in below.items():
        yield from commands(sub, f"{name} {key}".strip())


def options_with_paths() -> set[tuple[str, str]]:
    return {
        (name, option.opts[0])
        for name, command in commands(typer.main.get_command(app))
        for option in command.params
        if "pathlib.Path" in str(getattr(option, "type_descriptor", getattr(option, "type", "")))
    }


def test_each_option_with_a_path_has_a_row() -> None:
    # `eval --watch` has no row, since it waits until the folder exists.
    assert options_with_paths() == {*COMMANDS, ("eval", "--watch")}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "done"
    done = CliRunner().invoke(
        app, ["eval", "tabletop", *EPISODE, "--env-set", "max_steps=2", "--out", str(folder)]
    )
    assert done.exit_code == 0, done.output
    return folder


def is_wrong(command: str, option: str, path: str) -> bool:
    if path == "text" and command == "venv create":  # a requirements file, which pip reads
        return False
    return not (path == "folder/absent/below" and option == "--out" and command in MADE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "option", "path"),
    [(*words, path) for words in COMMANDS for path in PATHS if is_wrong(*words, path)],
)
def test_a_wrong_path_is_named_in_one_message(
    command: str,
    option: str,
    path: str,
    results: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "done").symlink_to(results)
    (tmp_path / "text").write_text("no file of this kind: [")
    (tmp_path / "folder").mkdir()
    (tmp_path / "r.txt").write_text("")
    deployment = (
        "applications: [{import_path: 'vlagents_ray.serve.app:build', args: {policy: noop}}]"
    )
    (tmp_path / "d.yaml").write_text(deployment)
    words = [*command.split(), *(word.format(path=path) for word in COMMANDS[command, option])]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "1000", "TERMINAL_WIDTH": "1000"})
    assert done.exception is None or isinstance(done.exception, SystemExit), (
        words,
        repr(done.exception),
    )
    assert "Traceback" not in done.output
    if (command, option, path) not in USABLE:
        assert done.exit_code != 0, done.output
        named = (path, path.partition("/")[0], "absent")
        assert any(name in done.output for name in named), done.output
