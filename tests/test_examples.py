"""The examples without a server work. Examples with a server are run by test_served_pages.py."""

from __future__ import annotations

import ast
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asgi_server import policy_server
from in_memory_keys import ChangingKeys
from readme_blocks import EXAMPLES, ROOT, code_of

from vlagents_ray.interface import Act, Agent, Obs

INDEX = (EXAMPLES / "README.md").read_text()
FILES = sorted(path for path in EXAMPLES.iterdir() if path.suffix in (".py", ".sh", ".ipynb"))


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the folder, in which a script can import the files next to it."""
    folder = tmp_path / "examples"
    shutil.copytree(EXAMPLES, folder, ignore=shutil.ignore_patterns("runs"))
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    return folder


def said(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """Return the output of a script."""
    monkeypatch.setattr(sys, "argv", [name])
    before = set(sys.modules)
    try:
        runpy.run_path(str(folder / name), run_name="__main__")
    finally:
        for module in set(sys.modules) - before:
            if Path(getattr(sys.modules[module], "__file__", None) or "/").parent == folder:
                del sys.modules[module]  # the next test imports a separate copy
    return capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "last"),
    [
        ("own_env.py", "CraneEnv keeps its contract"),
        ("own_policy.py", r"own_env:CraneEnv +20/20 +100% \[84, 100\]"),
        ("upstream.py", r"tabletop/lift +3/3"),
    ],
)
def test_a_script_does_what_it_says(
    name: str,
    last: str,
    reader: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert re.search(last, said(name, reader, monkeypatch, capsys))


@pytest.mark.slow
def test_the_sweep_shows_where_the_policy_fails(
    reader: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = said("sweep.py", reader, monkeypatch, capsys)
    rates = {
        line.split("  ")[0]: re.findall(r"(\d+)%", line)
        for line in out.splitlines()
        if line.startswith("spread")
    }
    assert list(rates) == ["spread 0.0", "spread 1.0"]
    assert {(each[0], each[-1]) for each in rates.values()} == {("100", "0")}


@pytest.mark.slow
def test_the_later_checkpoint_is_shown_to_be_better(
    reader: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    *_, total, difference = said("compare_checkpoints.py", reader, monkeypatch, capsys).splitlines()
    assert total.startswith("all: 40 pairs")
    low, p = re.search(r"rates: \+(\d+)% to .*, p = (\S+)", difference).groups()  # type: ignore[union-attr]
    assert int(low) > 0
    assert float(p) < 0.05


class Counting(Agent):
    """A policy that answers with the number of earlier calls and with the gripper, in the first of
    two rows.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._acts = 0
        return {}

    def act(self, obs: Obs) -> Act:
        rows = np.array([[self._acts, obs.gripper, 5], [-1, -1, -1]], np.float32)
        self._acts += 1
        return Act(rows)


def test_a_shell_is_a_client_with_a_key_or_is_told_that_it_lacks_one() -> None:
    keys = ChangingKeys()
    key = keys.add("robot")
    with policy_server(Counting(), keys=keys.keys) as port:
        command = [
            "bash",
            EXAMPLES / "curl.sh",
            f"http://127.0.0.1:{port}",
            ROOT / "clients/golden/gray.jpg",
        ]
        for environment in ({"VLAGENTS_RAY_API_KEY": key}, {}):
            done = subprocess.run(
                command,
                check=False,
                env=os.environ | environment,
                capture_output=True,
                text=True,
                timeout=60,
            )
            if environment:
                told = re.findall(r"^tick (\d+): (\d+)\.0,1\.0,5\.0$", done.stdout, re.MULTILINE)
                assert told == [(str(tick), str(tick - 1)) for tick in range(1, 11)]
                assert (done.returncode, done.stderr) == (0, "")
            else:
                assert done.returncode != 0
                assert "401" in done.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_an_example_says_how_to_run_it(path: Path) -> None:
    text = path.read_text()
    if path.suffix == ".ipynb":
        first = "".join(json.loads(text)["cells"][0]["source"])
        compile(code_of(path).source, path.name, "exec")
    else:
        first = (
            ast.get_docstring(ast.parse(text)) or ""
            if path.suffix == ".py"
            else text.partition("set -euo")[0]
        )
    assert path.name in first


def test_the_index_has_each_example_and_no_other() -> None:
    linked = set(re.findall(r"\]\(([^)]+)\)", INDEX))
    assert {path.name for path in FILES} <= linked
    assert {link for link in linked if not (EXAMPLES / link.partition("#")[0]).exists()} == set()
