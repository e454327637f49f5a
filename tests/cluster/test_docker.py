"""cluster/docker: what the Dockerfile names is there, and nothing it should not have. No container engine is needed."""

from __future__ import annotations

import fnmatch
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from dockerfile import instructions
from typer.testing import CliRunner

from vlagents_ray.cli.main import app

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "cluster" / "docker"
DOCKERFILE = FOLDER / "Dockerfile"
LINES = list(instructions(DOCKERFILE))
STAGES = [line.stage for line in LINES if line.word == "FROM"]
FAMILIES = sorted(file.stem for file in (ROOT / "requirements").glob("*.txt") if "." not in file.stem)


def of(word: str, stage: str | None = None) -> list[str]:
    return [line.text for line in LINES if line.word == word and stage in (None, line.stage)]


def copied() -> list[str]:
    """What of the repository is copied into any stage."""
    here = [line.text.split()[:-1] for line in LINES if line.word == "COPY" and "from" not in line.flags]
    return [path for paths in here for path in paths]


def test_hadolint_finds_nothing() -> None:
    hadolint = shutil.which("hadolint", path=Path(sys.executable).parent) or shutil.which("hadolint")
    assert hadolint is not None
    done = subprocess.run([hadolint, "--no-color", str(DOCKERFILE)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


def test_what_is_copied_exists_and_reaches_the_builder() -> None:
    ignored = (FOLDER / "Dockerfile.dockerignore").read_text().split("\n")
    kept = [line.removeprefix("!") for line in ignored if line.startswith("!")]
    assert "*" in ignored
    assert copied()
    for path in copied():
        assert (ROOT / path).exists(), path
        assert any(fnmatch.fnmatch(path, one) for one in kept), path
    assert set(kept) == set(copied())


def test_other_stages_are_named_before_they_are_copied_from() -> None:
    seen: list[str] = []
    for line in LINES:
        if line.word == "FROM":
            seen.append(line.stage)
        sources = [line.flags["from"]] if "from" in line.flags else re.findall(r"from=([\w-]+)", str(line.flags))
        assert set(sources) <= set(seen[:-1]), line
    assert len(STAGES) == len(set(STAGES))


def test_every_base_is_pinned_and_its_python_is_the_packages() -> None:
    [base] = [text.partition("=")[2] for text in of("ARG", "") if text.startswith("BASE=")]
    assert re.fullmatch(r"python:3\.11\.\d+-slim-bookworm", base)
    assert {text.partition(" AS ")[0] for text in of("FROM")} <= {"${BASE}", "scratch", *STAGES}


def test_torch_is_the_one_of_the_makefile() -> None:
    pinned = re.search(r"^TORCH \?= (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert pinned is not None
    assert pinned[1] in (FOLDER / "torch.txt").read_text().splitlines()
    installs = [run for run in of("RUN") if "--requirement" in run]
    assert len(installs) == 2
    assert all("--override torch.txt" in run for run in installs)


@pytest.mark.parametrize("run", of("RUN"), ids=range(len(of("RUN"))))
def test_a_step_is_shell(run: str) -> None:
    parsed = subprocess.run(["sh", "-n"], input=run, capture_output=True, text=True, check=False)
    assert parsed.returncode == 0, parsed.stderr


@pytest.mark.parametrize("family", FAMILIES)
def test_a_familys_packages_can_be_named(family: str) -> None:
    [run] = [run for run in of("RUN", "family-packages") if "$FAMILY" in run]
    [named] = re.findall(r'--requirement "(\S+)"', run)
    assert (ROOT / named.replace("$FAMILY", family)).is_file()


def test_what_runs_is_no_root_and_says_how_it_is() -> None:
    last = STAGES[-1]
    assert of("USER", last) == ["1000:1000"]
    assert LINES.index(next(line for line in LINES if line.word == "USER")) > max(
        number for number, line in enumerate(LINES) if line.word in ("RUN", "COPY")
    )
    [health] = of("HEALTHCHECK", last)
    assert "http://127.0.0.1:8000/healthz" in health
    assert json.loads(of("ENTRYPOINT", last)[0])[0] == "tini"
    assert "tini wget" in of("RUN", last)[0]


def test_packages_lie_below_our_code() -> None:
    for stage in STAGES:
        words = [line for line in LINES if line.stage == stage]
        ours = [n for n, line in enumerate(words) if line.word == "COPY" and "vlagents_ray" in line.text]
        installs = [n for n, line in enumerate(words) if "--requirement" in line.text]
        assert all(install < our for install in installs for our in ours)
    assert of("COPY", "wheel")[-1].startswith("vlagents_ray ")
    assert not any("vlagents_ray" in text for stage in STAGES if stage != "wheel" for text in of("COPY", stage))


def test_its_command_asks_for_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    for variable in ("VLAGENTS_RAY_KEYS", "VLAGENTS_RAY_KEYS_FILE"):
        monkeypatch.delenv(variable, raising=False)
    name, *words = json.loads(of("CMD", STAGES[-1])[0])
    assert name == "vlagents-ray"
    result = CliRunner().invoke(app, words)
    assert result.exit_code != 0
    assert "keys new" in result.output
