"""No output of a command is truncated, wrapped where users copy it, or interpreted as markup."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from vlagents_ray.cli import console, listing
from vlagents_ray.cli.console import PlainConsole, table
from vlagents_ray.cli.main import app, envs, policies
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.registry import entries, names, pip_install

CLI = Path(console.__file__).parent
CURE = (
    "pip install 'vlagents-ray[libero]' [/] \\[red] and /a/very/long/path/"
    + "of-an-interpreter/" * 8
    + "bin/python"
)


@pytest.fixture(params=[True, False], ids=["terminal", "pipe"])
def shown(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Return the printed text, at a terminal of 80 columns or through a pipe."""
    text = io.StringIO()
    colours = {"color_system": None, "_environ": {"COLUMNS": "80", "TERM": "xterm"}}
    one = PlainConsole(file=text, force_terminal=request.param, **colours)
    for module in (console, sys.modules[envs.__module__]):
        monkeypatch.setattr(module, "out", one, raising=False)
    monkeypatch.setattr(console, "err", one)
    return text


def test_a_line_and_an_error_are_shown_as_they_are(shown: io.StringIO) -> None:
    console.progress(CURE)
    console.say_error(CURE)
    assert shown.getvalue() == f"{CURE}\nError: {CURE}\n"


def test_a_table_cuts_nothing_off(shown: io.StringIO) -> None:
    rows = table("name", "cure", box=None)
    rows.add_row("libero", CURE)
    console.out.print(rows)
    said = shown.getvalue()
    assert re.sub(r"\s", "", CURE) in re.sub(
        r"\s|libero(?= )", "", said.replace("name", "").replace("cure", "")
    )
    assert "…" not in said
    if not console.out.is_terminal:
        assert f"libero {CURE}" in re.sub(" +", " ", said)


class Elsewhere(Tabletop):
    @classmethod
    def missing(cls) -> str | None:
        return CURE

    @classmethod
    def tasks(cls) -> list[str]:
        return [
            *(f"goal/{number}" for number in range(50)),
            "other",
            "long/1",
            "long/2",
            "odd/1",
            "odd/3",
        ]


def test_envs_are_listed_with_their_cures_and_ranges_of_tasks(
    shown: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        listing,
        "names",
        lambda _: {"elsewhere": f"{__name__}:Elsewhere", "too": f"{__name__}:Elsewhere"},
    )
    monkeypatch.setattr(listing, "env_class", lambda _: Elsewhere)
    envs()
    said = shown.getvalue()
    _, *listed = [line.split(maxsplit=2) for line in said.partition("\n\n")[0].splitlines()]
    if not console.out.is_terminal:
        assert [(name, here, what.strip()) for name, here, what in listed] == [
            ("elsewhere", "no", "55 tasks: goal/0..49, other, long/1..2, odd/1, odd/3"),
            ("too", "no", "55 tasks: goal/0..49, other, long/1..2, odd/1, odd/3"),
        ]
    assert said.partition("\n\n")[2] == f"for the rest:\n  elsewhere, too: {CURE}\n"
    with pytest.raises(typer.Exit):
        envs("nope")
    assert "'nope' is not registered; there are elsewhere, too" in shown.getvalue()


def test_a_listing_is_as_wide_as_a_terminal_and_has_a_line_for_each_elsewhere(
    shown: io.StringIO,
) -> None:
    policies()
    rows = shown.getvalue().partition("\n\n")[0].splitlines()
    if console.out.is_terminal:
        assert max(map(len, rows)) <= 80
    else:
        assert sorted(row.split()[0] for row in rows[1:]) == sorted(
            [*names("policies"), *names("wrappers")]
        )
    assert "…" not in shown.getvalue()


def test_what_installs_the_rest_is_said_once_for_all_that_want_it(
    shown: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listing.importlib.util, "find_spec", lambda _: None)
    monkeypatch.delenv("VJEPA2_SRC", raising=False)
    monkeypatch.setenv("OPENVLA_SRC", "/src/openvla")
    policies()
    rest = shown.getvalue().partition("\n\n")[2].splitlines()
    assert rest[0] == "for the rest, whose Python a deployment names as `environment`:"
    of_hf = sorted(
        name for name, one in entries("policies").items() if one.requirements[:1] == ("hf",)
    )
    assert {"pi0", "vjepa2_ac"} <= set(of_hf)
    assert f"  vlagents-ray venv create hf  # {', '.join(of_hf)}" in rest
    assert "  vlagents-ray venv create openvla  # openvla, openvla_oft" in rest
    assert "  export VJEPA2_SRC=FOLDER  # a checkout, for vjepa2_ac" in rest
    assert not any("OPENVLA" in line for line in rest)
    cure = pip_install("onnx", "vlagents-ray-models")
    assert f"  onnx: not in this environment (onnxruntime): {cure}" in rest


def test_of_one_policy_all_is_said(shown: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing.importlib.util, "find_spec", lambda _: None)
    monkeypatch.delenv("OPENPI_SRC", raising=False)
    policies("noop")
    assert shown.getvalue().splitlines() == [
        (
            "noop: A policy that returns zeros after an adjustable time, to measure the overhead "
            "around a policy."
        ),
        "  ready",
        "  settings: action_dim=7, delta=None, chunk=1, base_ms=0.0, per_item_ms=0.0",
    ]
    policies("openpi")
    assert "venv create openpi`" in shown.getvalue()
    assert "OPENPI_SRC=FOLDER of a checkout" in shown.getvalue()
    with pytest.raises(typer.Exit) as ended:
        policies("opnpi")
    assert ended.value.exit_code == 2
    assert "'opnpi' is not registered; did you mean 'openpi'" in shown.getvalue()


def test_a_policy_is_described_as_its_entry_describes_it() -> None:
    described = {row.name: row.what for row in listing.policies_and_wrappers()}
    for name, entry in (entries("policies") | entries("wrappers")).items():
        if entry.about:
            assert described[name] == entry.about


def test_the_reference_policy_is_not_ready_without_torch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        listing.importlib.util, "find_spec", lambda name: None if name == "torch" else object()
    )
    [reference] = [row for row in listing.policies_and_wrappers() if row.name == "reference"]
    cure = "run `pip install torch` in the policy's environment"
    assert reference.missing == f"not in this environment (torch): {cure}"
    assert f"reference: {reference.missing}" in list(listing.installing([reference]))


def test_an_environment_that_has_a_family_is_ready_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        listing.importlib.util, "find_spec", lambda name: None if name == "openpi" else object()
    )
    monkeypatch.delenv("OPENPI_SRC", raising=False)
    assert "its source" in str(listing.missing_packages("openpi"))
    monkeypatch.setenv("OPENPI_SRC", "/src/openpi")
    assert listing.missing_packages("openpi") is None
    assert listing.missing_packages("lerobot") is None


def test_no_command_prints_on_a_console_or_in_a_table_of_its_own() -> None:
    for file in CLI.rglob("*.py"):
        text = file.read_text()
        if file.name != "console.py":
            assert not re.search(r"\bConsole\(|Console\(stderr|\[bold\]|\[/\]|from_markup", text), (
                file.name
            )
            # evaluation/run.py and doctor.py use tables, which must fold.
            for made in re.findall(r"\bTable\((.*)\)", text):
                assert 'overflow="fold"' in text, (file.name, made)


def test_a_command_loads_neither_ray_nor_torch_unasked_and_ends_without_looking_for_garbage_once_more() -> (
    None
):
    """A garbage collection at the exit would scan all of Ray, which takes half a second."""
    code = (
        "import atexit, gc, sys; from vlagents_ray.cli import main; sys.argv = ['vlagents-ray', "
        "'--help']; "
        "atexit.register(lambda: print(gc.get_freeze_count() > 0, {'ray', 'torch'} & "
        "set(sys.modules))); main()"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120
    )
    assert ran.stdout.splitlines()[-1] == "True set()"


def test_all_commands_are_on_one_screen() -> None:
    said = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80", "TERMINAL_WIDTH": "80"}).output
    names = re.findall(r"^  ([a-z][\w-]*)  ", said, re.MULTILINE)
    assert names[:5] == ["serve", "eval", "robot", "demo", "doctor"]
    # The help text of each command fits on one line.
    assert len(said.splitlines()) <= len(names) + 18


HOSTILE = (
    "\x1b]0;TITLE\x07\x1b[2J\x1b]52;c;ZXZpbA==\x07\x1b[31mOK\x1b[0m \x9b31m \u202eevil\r\n"
    "2026-11-28 INFO robot: restarted"
)


def commands_of_a_terminal(text: str) -> list[str]:
    return [character for character in text if not (character.isprintable() or character in "\n\t")]


def test_text_of_others_commands_no_terminal(shown: io.StringIO) -> None:
    console.progress(HOSTILE)
    console.say_error(HOSTILE)
    rows = table(HOSTILE)
    rows.add_row(HOSTILE)
    console.out.print(rows)
    console.print_json({HOSTILE: HOSTILE})
    assert "OK" in shown.getvalue()
    assert commands_of_a_terminal(shown.getvalue()) == []
