"""The option `--json` of each command that has it: stdout contains one document and nothing
else.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from eval_fakes import LINE
from in_process_evaluation import play
from typer.testing import CliRunner

from vlagents_ray.cli import doctor, listing
from vlagents_ray.cli.doctor import Check
from vlagents_ray.cli.main import app
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.registry import names


def offering(command: Any, name: str = "") -> Iterator[str]:
    """Return the names of the commands that have the option."""
    for one, below in getattr(command, "commands", {}).items():
        yield from offering(below, f"{name} {one}".strip())
    if any("--json" in param.opts for param in command.params):
        yield name


def test_what_a_script_reads_is_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "checks", lambda *_: [("Ray", Check("fail", "none", "install it"))])
    # Other environments would load simulators.
    monkeypatch.setattr(listing, "env_class", lambda _: Tabletop)
    policies = [
        {"name": name, "url": f"http://localhost:{port}"} for port, name in enumerate(("a", "b"), 1)
    ]
    out = tmp_path / "out"
    suites = [{"envs": [LINE], "episodes": 2}]
    play(EvalConfig(policies=policies, suites=suites, record="all", video="none", out=out))
    assert (
        CliRunner().invoke(app, ["bundle", str(out), "--out", str(tmp_path / "b.zip")]).exit_code
        == 0
    )
    words = {
        "policies": [],
        "envs": ["tabletop"],
        "doctor": [],
        "report": [str(out)],
        "verify": [str(tmp_path / "b.zip"), "--replay", "0"],
    }
    assert {*offering(typer.main.get_command(app))} == words.keys()
    said = {}
    for name, beside in words.items():
        done = CliRunner().invoke(app, [name, *beside, "--json"])
        assert (name, done.exit_code, done.stderr) == (name, int(name == "doctor"), "")
        said[name] = json.loads(done.stdout)
    found = {one["name"]: one for one in said["policies"]}
    assert found.keys() == {*names("policies"), *names("wrappers")}
    assert (found["noop"]["kind"], found["noop"]["missing"]) == ("policy", None)
    assert found["noop"]["details"][0] == "action_dim=7"
    assert [one["name"] for one in said["envs"]] == ["tabletop"]
    assert said["doctor"] == [
        {"check": "Ray", "status": "fail", "detail": "none", "cure": "install it"}
    ]
    (pair,) = said["report"]["comparisons"]
    # The same order as on the page.
    assert (pair["a"], pair["b"], pair["lines"][-1]["suite"]) == ("b", "a", "all")
    assert sum(case["episodes"] for case in said["report"]["cases"]) == 4
    assert not (out / "report.html").exists()
    assert (said["verify"]["reproduced"], said["verify"]["tried"]) == (0, 0)
