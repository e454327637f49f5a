"""cluster/docker: the Dockerfile copies existing files and no forbidden ones, and installs each
package by its digest.

No container engine is needed. The locks meet the requirements of pyproject.toml and of the
plug-ins' requirements/.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import resolved
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.testing import CliRunner

from vlagents_ray.cli.main import app

pytestmark = pytest.mark.integration


@dataclass(frozen=True)
class Instruction:
    stage: str  # the name of the stage
    word: str  # the instruction in capitals: RUN
    flags: dict[str, str]  # --from=build: {"from": "build"}
    text: str  # the remaining text, on one line


def instructions(file: Path) -> Iterator[Instruction]:
    """Yield the instructions of a Dockerfile in order. Those before the first FROM have the stage
    "". Raise `ValueError` for an invalid line.
    """
    stage = ""
    kept = "\n".join(
        line for line in file.read_text().splitlines() if not line.lstrip().startswith("#")
    )
    for line in re.sub(r"\\\n", "", kept).splitlines():
        if not line.strip():
            continue
        match = re.fullmatch(r"([A-Z]+)((?:\s+--[\w-]+=\S+)*)\s+(.*)", line)
        if match is None:
            raise ValueError(f"{file}: {line!r} is not an instruction")
        word, flags, text = match.groups()
        if word == "FROM":
            stage = text.rpartition(" AS ")[2]
        yield Instruction(stage, word, dict(re.findall(r"--([\w-]+)=(\S+)", flags)), text.strip())


ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "cluster" / "docker"
DOCKERFILE = FOLDER / "Dockerfile"
LINES = list(instructions(DOCKERFILE))
STAGES = [line.stage for line in LINES if line.word == "FROM"]
TARGETS = [
    line.stage for line in LINES if line.word == "LABEL" and line.stage != "system"
] + STAGES[-1:]
LOCKS = {  # locks of the stages that install packages
    line.stage: found[1]
    for line in LINES
    if (found := re.search(r"source=(\S+/locks/[^,]+)", line.flags.get("mount", "")))
}
INSTALL = (FOLDER / "install.sh").read_text()
SIMULATORS = resolved.simulators()
FAMILIES = [file.stem for file in resolved.families()]
MODELS = set(FAMILIES) - set(SIMULATORS) - {"libero_pro", "rcs", "robosuite"}


def of(word: str, stage: str | None = None) -> list[str]:
    return [line.text for line in LINES if line.word == word and stage in (None, line.stage)]


def copied() -> list[str]:
    """Return the paths of the repository that are copied into any stage, or mounted during
    a step.
    """
    here = [
        line.text.split()[:-1] for line in LINES if line.word == "COPY" and "from" not in line.flags
    ]
    return [path for paths in here for path in paths] + list(LOCKS.values())


def test_hadolint_finds_nothing() -> None:
    hadolint = shutil.which("hadolint", path=Path(sys.executable).parent) or shutil.which(
        "hadolint"
    )
    assert hadolint is not None
    done = subprocess.run(
        [hadolint, "--no-color", str(DOCKERFILE)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


def test_what_is_copied_exists_and_reaches_the_builder() -> None:
    ignored = (FOLDER / "Dockerfile.dockerignore").read_text().split("\n")
    kept = [line.removeprefix("!") for line in ignored if line.startswith("!")]
    assert "*" in ignored
    assert copied()
    for path in copied():
        assert (ROOT / path).exists(), path
        assert any(path == one or path.startswith(f"{one}/") for one in kept), path
    assert all(any(path.startswith(one) for path in copied()) for one in kept)


def test_other_stages_are_named_before_they_are_copied_from() -> None:
    seen: list[str] = []
    for line in LINES:
        if line.word == "FROM":
            seen.append(line.stage)
        sources = (
            [line.flags["from"]]
            if "from" in line.flags
            else re.findall(r"from=([\w-]+)", str(line.flags))
        )
        assert set(sources) <= set(seen[:-1]), line
    assert len(STAGES) == len(set(STAGES))


def test_every_base_is_pinned_and_its_python_is_the_packages() -> None:
    [base] = [text.partition("=")[2] for text in of("ARG", "") if text.startswith("BASE=")]
    assert re.fullmatch(r"python:3\.11\.\d+-slim-bookworm", base)
    assert {text.partition(" AS ")[0] for text in of("FROM")} <= {"${BASE}", "scratch", *STAGES}


@pytest.mark.parametrize(
    ("version", "base", "built"),
    [
        ("", "python:3.11.14-slim-bookworm", True),
        ("0.1.0", "python:3.11.14-slim-bookworm@sha256:" + 64 * "0", True),
        ("0.1.0", "python:3.11.14-slim-bookworm", False),
    ],
)
def test_a_version_is_built_on_a_base_with_its_digest_alone(
    version: str, base: str, built: bool
) -> None:
    [step] = [run for run in of("RUN", "system") if "sha256" in run]
    done = subprocess.run(
        ["sh", "-c", step],
        env={"VERSION": version, "BASE": base},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode == 0) is built
    assert built or f"got {base}, want a base with its digest" in done.stderr
    assert 'org.opencontainers.image.base.name="$BASE"' in of("LABEL", "system")[0]


def test_torch_is_the_one_of_the_makefile() -> None:
    pinned = re.search(r"^TORCH \?= (\S+)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert pinned is not None
    assert pinned[1] in (FOLDER / "torch.txt").read_text().splitlines()


def test_every_package_is_installed_by_its_hash_and_lies_where_its_lock_says() -> None:
    assert 'uv pip install --python "$1" --require-hashes' in INSTALL
    assert list(LOCKS) == [stage for stage in STAGES if stage.endswith("-packages")]
    for stage, lock in LOCKS.items():
        kind, _, name = Path(lock).stem.partition("-")
        assert of("RUN", stage) == [f"./install.sh /opt/{kind}"]
        assert stage == ("server-packages" if name == "sim" else f"{name}-packages")
        assert re.search(r" for Python 3\.\d+ ", (ROOT / lock).read_text().partition("\n")[0])


@pytest.mark.parametrize("run", [*of("RUN"), INSTALL], ids=range(len(of("RUN")) + 1))
def test_a_step_is_shell(run: str) -> None:
    parsed = subprocess.run(["sh", "-n"], input=run, capture_output=True, text=True, check=False)
    assert parsed.returncode == 0, parsed.stderr


def chain(target: str) -> list[str]:
    """Return the stages of a target, from the last one to its base."""
    [base] = [text.partition(" AS ")[0] for text in of("FROM", target)]
    return [target, *(chain(base) if base in STAGES else [])]


def test_every_family_and_every_simulator_has_a_target_and_the_last_is_the_servers() -> None:
    assert sorted(TARGETS) == sorted([*FAMILIES, *(set(SIMULATORS) - set(FAMILIES)), "server"])
    assert STAGES[-1] == "server"


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_brings_its_own_packages_into_the_servers_environment_or_beside_it(
    target: str,
) -> None:
    environments = {}
    for stage in chain(target):
        for line in [
            line
            for line in LINES
            if line.stage == stage and line.flags.get("from", "").endswith("-packages")
        ]:
            kind, _, name = Path(LOCKS[line.flags["from"]]).stem.partition("-")
            assert line.text.split() == [f"/opt/{kind}", f"/opt/{kind}"]
            environments[kind] = name
    in_server = target in SIMULATORS
    assert environments == (
        {"server": target}
        if in_server
        else {"server": "sim"} | ({} if target == "server" else {"family": target})
    )
    assert f"vlagents-ray-{target}" in "".join(of("LABEL", target)) or target == "server"


@pytest.mark.parametrize("target", TARGETS)
def test_what_runs_is_no_root_and_owns_nothing_but_where_it_writes(target: str) -> None:
    stages = [line for stage in reversed(chain(target)) for line in LINES if line.stage == stage]
    users = [i for i, line in enumerate(stages) if line.word == "USER"]
    # Only the installation of a model's compiler runs as root.
    assert [stages[i].text for i in users] == [
        "1000:1000",
        *(["0:0", "1000:1000"] if target in MODELS else []),
    ]
    after = stages[users[-1] :]
    assert not [line for line in after if line.word in ("RUN", "ADD") or "chown" in line.flags]
    assert json.loads(of("VOLUME", "system")[0]) == ["/tmp", "/home/robot", "/results"]


@pytest.mark.parametrize("target", TARGETS)
def test_models_alone_have_a_compiler(target: str) -> None:
    """Triton compiles a C program when a model runs on a GPU."""
    installed = " ".join(
        run for stage in chain(target) for run in of("RUN", stage) if "apt-get install" in run
    )
    assert ("gcc libc6-dev" in installed) is (target in MODELS)


@pytest.mark.parametrize(
    ("package", "headers", "built"), [("triton", 1, True), ("triton", 0, False), ("six", 0, True)]
)
def test_triton_needs_the_headers_of_its_python(
    package: str, headers: bool, built: bool, tmp_path: Path
) -> None:
    """install.sh runs with a stand-in for uv that installs nothing, and with a Python that names a
    folder of headers.
    """
    environment, include = tmp_path / "environment", tmp_path / "include"
    for folder in (include, environment / "bin", environment / "lib/python3.11/site-packages"):
        folder.mkdir(parents=True)
    for file, line in (
        (tmp_path / "uv", "exit 0"),
        (environment / "bin/python", f"echo {include}"),
    ):
        file.write_text(f"#!/bin/sh\n{line}\n")
        file.chmod(0o755)
    if headers:
        (include / "Python.h").touch()
    (tmp_path / "lock.txt").write_text(
        f"# x, for Python 3.11 on y: `make locks` writes it.\n{package}==1.0\n"
    )
    command = ["sh", str(FOLDER / "install.sh"), str(environment)]
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        command, cwd=tmp_path, env=path, capture_output=True, text=True, check=False
    )
    assert (done.returncode == 0) is built, done.stderr
    assert built or f"no {include}/Python.h" in done.stderr


def test_it_says_how_it_is() -> None:
    [health] = of("HEALTHCHECK", "system")
    assert "http://127.0.0.1:8000/healthz" in health
    assert json.loads(of("ENTRYPOINT", "system")[0])[0] == "tini"
    assert "tini wget" in of("RUN", "system")[0]


@pytest.mark.parametrize("target", TARGETS)
def test_packages_lie_below_our_code(target: str) -> None:
    copies = [line.flags["from"] for line in LINES if line.stage == target and line.word == "COPY"]
    assert copies[-1] == "code"
    assert "code" not in copies[:-1]
    ours = [
        line.stage
        for line in LINES
        if line.word == "COPY" and line.text.startswith("vlagents_ray ")
    ]
    assert ours == ["code"]


def test_a_release_builds_targets_on_the_bases_digest() -> None:
    job = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text())["jobs"]["images"]
    assert set(job["strategy"]["matrix"]["target"]) <= set(TARGETS)
    build = job["steps"][-1]["run"]
    used = dict(re.findall(r'--build-arg (\w+)="([^"]*)"', build))
    assert used["BASE"] == "$base@$digest"
    assert set(used) == {"BASE", "VERSION", "REVISION"}
    assert subprocess.run(["bash", "-n"], input=build, text=True, check=False).returncode == 0


def test_the_page_names_every_target_and_all_that_is_written_to() -> None:
    page = (ROOT / "docs/cluster/images.md").read_text()
    rows = re.findall(r"^\| (`.*?) \|", page.partition("## How an image runs")[0], re.MULTILINE)
    assert sorted(name for row in rows for name in re.findall(r"`(\w+)`", row)) == sorted(TARGETS)
    for path in json.loads(of("VOLUME", "system")[0]):
        assert f"`{path}`" in page
    shell = "\n".join(re.findall(r"```bash\n(.*?)```", page, re.DOTALL))
    assert subprocess.run(["bash", "-n"], input=shell, text=True, check=False).returncode == 0
    assert set(re.findall(r"--target (\w+)", shell)) <= set(TARGETS)


def test_its_command_asks_for_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    for variable in ("VLAGENTS_RAY_KEYS", "VLAGENTS_RAY_KEYS_FILE"):
        monkeypatch.delenv(variable, raising=False)
    name, *words = json.loads(of("CMD", "system")[0])
    assert name == "vlagents-ray"
    result = CliRunner().invoke(app, words)
    assert result.exit_code != 0
    assert "keys create" in result.output


ENTRY = re.compile(r"([a-z0-9-]+)==(\S+)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n")


def locked(text: str) -> dict[str, str]:
    """Return the versions in a lock by name. The lock consists of a comment and of packages with
    digests.
    """
    comment, _, entries = text.partition("\n")
    assert comment.startswith("# ")
    assert ENTRY.sub("", entries) == "", (
        "the lock has a line that is neither a version nor a digest"
    )
    return {name: version for name, version, _ in ENTRY.findall(entries)}


def unmet(versions: dict[str, str], requirements: list[str]) -> list[str]:
    """Return the requirements that no locked version meets."""
    wanted = [Requirement(text) for text in requirements]
    torch = {one.name: one for one in map(Requirement, resolved.overrides(requirements))}
    wanted = [
        torch.get(one.name, one) for one in wanted if one.marker is None or one.marker.evaluate()
    ]
    return [
        str(one)
        for one in wanted
        if (version := versions.get(canonicalize_name(one.name))) is None
        or not one.specifier.contains(version)
    ]


def test_there_is_a_lock_for_every_image_and_no_other() -> None:
    assert {file.stem for file in resolved.LOCKS.iterdir()} == resolved.locks().keys()
    assert {"server-sim", "server-maniskill", "family-hf", "family-octo"} <= resolved.locks().keys()


@pytest.mark.parametrize("name", resolved.locks())
def test_a_lock_meets_what_its_image_wants_and_has_a_digest_of_every_package(name: str) -> None:
    python, requirements = resolved.locks()[name]
    text = (resolved.LOCKS / f"{name}.txt").read_text()
    assert f"for Python {python} on {resolved.PLATFORM}:" in text
    versions = locked(text)
    assert len(versions) > 60
    torch = [
        text for text in resolved.overrides(requirements) if Requirement(text).name in versions
    ]
    assert unmet(versions, [*requirements, *torch]) == [], "run `make locks`"


@pytest.mark.parametrize("name", resolved.locks())
def test_a_lock_has_no_library_of_nvidia_twice(name: str) -> None:
    """Libraries of two CUDA versions would overwrite each other: nvidia-cudnn-cu12 and -cu13 both
    install into nvidia/cudnn/lib.
    """
    packages = [
        one
        for one in locked((resolved.LOCKS / f"{name}.txt").read_text())
        if one.startswith("nvidia-")
    ]
    libraries = [re.sub(r"-cu\d+$", "", one) for one in packages]
    assert sorted(libraries) == sorted(set(libraries)), packages


def test_a_lock_that_is_out_of_date_or_has_no_digest_is_told() -> None:
    text = "# a comment\nnumpy==2.4.6 \\\n    --hash=sha256:" + 64 * "0" + "\n"
    assert locked(text) == {"numpy": "2.4.6"}
    assert unmet(locked(text), ["numpy>=1.24"]) == []
    assert unmet(locked(text), ["numpy>=2.5", "pillow>=10"]) == ["numpy>=2.5", "pillow>=10"]
    with pytest.raises(AssertionError, match="neither"):
        locked(text + "pillow==12.0\n")
