"""The files for citing, building and publishing the project are valid for their own tools."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import release
import resolved
import tomllib
import yaml
from packaging.requirements import Requirement

from vlagents_ray.ray_tools.private import requirement

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
MAKEFILE = (ROOT / "Makefile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def steps(workflow: Path) -> list[dict[str, Any]]:
    return [
        step
        for job in yaml.safe_load(workflow.read_text())["jobs"].values()
        for step in job["steps"]
    ]


@pytest.mark.integration
def test_workflows_are_well_formed() -> None:
    program = shutil.which("jactionlint", path=Path(sys.executable).parent) or shutil.which(
        "jactionlint"
    )
    assert program is not None
    done = subprocess.run(
        [program, "--shellcheck=", *WORKFLOWS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(WORKFLOWS) == 4


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_what_workflows_run_of_this_repository_exists(workflow: Path) -> None:
    rules = re.findall(r"^([a-z][a-z ]*):", MAKEFILE, re.MULTILINE)
    targets = {target for rule in rules for target in rule.split()}
    commands = [step["run"] for step in steps(workflow) if "run" in step]
    assert commands
    for command in commands:
        assert set(re.findall(r"^make ([a-z]+)", command)) <= targets
        for path in re.findall(r"(?:\.ci|tests)/[\w/.]*", command):
            assert (ROOT / path).exists(), path


def test_the_makefile_holds_ray_at_the_versions_of_a_server() -> None:
    """Later installations into `.venv` must not replace Ray, whose version clients share."""
    recipe = re.search(r"^\t@(sed .*) pyproject.toml >>\$@$", MAKEFILE, re.MULTILINE)
    assert recipe is not None
    command = ["bash", "-c", f"{recipe[1]} pyproject.toml"]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    [held] = map(Requirement, done.stdout.splitlines())
    assert held.name == "ray"
    assert held.specifier == Requirement(requirement()).specifier


def test_the_flood_table_is_played_whole_each_night() -> None:
    """`make integrations` runs only part of the table's rows, and too briefly for p99."""
    table = "tests/serve/test_flood.py"
    settings = set(re.findall(r"VLAGENTS_FLOOD_[A-Z]+", (ROOT / table).read_text()))
    assert settings == {"VLAGENTS_FLOOD_ALL", "VLAGENTS_FLOOD_SECONDS"}
    nightly = [path for path in WORKFLOWS if "cron:" in path.read_text()]
    [step] = [step for path in nightly for step in steps(path) if table in step.get("run", "")]
    assert set(step["env"]) == settings
    assert float(step["env"]["VLAGENTS_FLOOD_SECONDS"]) >= 10


def test_the_citation_names_this_licence() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["license"] == PROJECT["license"]


def test_files_that_repeat_the_version_have_that_of_the_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert release.other_versions() == []
    monkeypatch.setattr(release, "VERSION", "9.9.9")
    assert len(release.other_versions()) == len(release.REPEATED)


def test_each_plugin_works_with_this_version_of_the_core() -> None:
    for path in sorted((ROOT / "plugins").glob("*/pyproject.toml")):
        plugin = tomllib.loads(path.read_text())["project"]
        [core] = [
            requirement
            for requirement in map(Requirement, plugin["dependencies"])
            if requirement.name == PROJECT["name"]
        ]
        assert core.specifier.contains(release.VERSION), path


def test_a_version_is_released_once_its_changelog_has_a_date() -> None:
    assert release.unfinished(f"# Changelog\n\n## [{release.VERSION}] - 2026-12-24\n") == []
    [problem] = release.unfinished("# Changelog\n\n## [Unreleased]\n")
    assert f"## [{release.VERSION}]" in problem


def test_the_packages_of_each_extra_are_recorded_for_its_present_requirements() -> None:
    notes = resolved.notes()
    assert list(notes) == [extra or "none" for extra in resolved.extras()]
    for found in notes.values():
        assert tuple(found["packages"]) == resolved.PYTHONS
        counts = found["packages"].values()
        assert all(re.fullmatch(r"\d+\*?|no", count) for count in counts)
        assert any("*" in count for count in counts) == bool(found["compiled"])
    old = []
    for extra in resolved.extras():
        name = extra or "none"
        if resolved.digest(extra) != notes[name]["digest"]:
            old.append(name)
    assert old == [], f"run `make extras ONLY='{' '.join(old)}'`"


def test_extras_that_are_not_named_stay_as_they_are(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        resolved, "packages", lambda _, python: ("7*", ["a"]) if python == "3.13" else ("6", [])
    )
    before = resolved.notes()
    after = resolved.resolved_extras(["record"])
    counts = {"3.10": "6", "3.11": "6", "3.12": "6", "3.13": "7*"}
    digest = resolved.digest("record")
    record = {"digest": digest, "packages": counts, "compiled": ["a"]}
    assert after == before | {"record": record}
    monkeypatch.setattr(resolved, "NOTED", tmp_path / "extras.json")
    resolved.write_extras(after)
    assert resolved.notes() == after


def test_a_changed_requirement_or_torch_makes_the_packages_old(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    before = {extra: resolved.digest(extra) for extra in resolved.extras()}
    (tmp_path / "torch.txt").write_text("torch==9.0\n")
    with monkeypatch.context() as patch:
        patch.setattr(resolved, "TORCH", tmp_path / "torch.txt")
        assert all(resolved.digest(extra) != digest for extra, digest in before.items())
    monkeypatch.setitem(resolved.EXTRAS, "record", ["av>=13"])
    changed = {extra for extra, digest in before.items() if resolved.digest(extra) != digest}
    assert "record" in changed
    assert not changed & {None, "serve", "limits"}


def test_the_digest_of_an_extra_is_the_same_in_each_process() -> None:
    command = [sys.executable, "-c", "import resolved; print(resolved.digest('maniskill'))"]
    digests = set()
    for seed in range(4):  # hash seeds, which determine the order of sets of texts
        env = {
            **os.environ,
            "PYTHONHASHSEED": str(seed),
            "PYTHONPATH": str(Path(resolved.__file__).parent),
        }
        digests.add(
            subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
        )
    assert len(digests) == 1


def test_the_requirements_of_an_extra_are_those_of_the_extras_that_it_names_too() -> None:
    assert (
        set(resolved.direct("maniskill"))
        > set(resolved.direct("sim"))
        > set(resolved.direct("serve"))
    )
    assert (
        set(resolved.direct("serve")) > set(resolved.direct(None)) == set(PROJECT["dependencies"])
    )
    assert not any(
        one.startswith(PROJECT["name"])
        for extra in resolved.EXTRAS
        if extra != "all"
        for one in resolved.direct(extra)
    )
