"""The wheel contains the whole package, and works with only the light dependencies."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from vlagents_ray.serve.python_env.create import installed_wheel

ROOT = Path(__file__).parents[1]
LIGHT_DEPENDENCIES = {"numpy", "simplejpeg", "websockets"}

pytestmark = pytest.mark.slow


def pip(*arguments: str) -> str:
    """Return this environment's pip, which can install into other environments (`--python`) that
    have none.
    """
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    if done.returncode != 0:
        pytest.fail(f"{' '.join(command)}\n{done.stdout}\n{done.stderr}")
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy, since building writes into the source tree."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(
        ROOT / "vlagents_ray", source / "vlagents_ray", ignore=shutil.ignore_patterns("__pycache__")
    )
    pip(
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--wheel-dir",
        str(out),
        str(source),
    )
    (built,) = out.glob("vlagents_ray-*.whl")
    return built


@pytest.fixture(scope="module")
def robot(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the Python of an empty environment into which only the wheel was installed."""
    home = tmp_path_factory.mktemp("robot")
    venv.create(home, with_pip=False, symlinks=True)
    python = home / "bin" / "python"
    pip(
        "--python",
        str(python),
        "install",
        "--quiet",
        "--no-compile",
        "--only-binary=:all:",
        str(wheel),
    )
    return python


def run(python: Path, code: str) -> str:
    done = subprocess.run(
        [python, "-I", "-c", code], check=False, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_wheel_holds_every_module_and_the_licence_and_no_tests(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "vlagents_ray").rglob("*.py")}
    assert modules - names == set()
    assert "vlagents_ray/py.typed" in names
    page = ROOT / "vlagents_ray/evaluate/report"
    resources = {
        str(path.relative_to(ROOT))
        for pattern in ("report.*", "templates/*")
        for path in page.glob(pattern)
    }
    resources |= {
        str(path.relative_to(ROOT)) for path in (ROOT / "vlagents_ray/cli/skeletons").glob("*/*")
    }
    assert len(resources) >= 13
    assert resources - names == set()
    assert [name for name in names if name.endswith(".dist-info/licenses/LICENSE")]
    assert [
        name for name in names if name.startswith(("benchmarks/", "tests/", "deployments/"))
    ] == []


def test_the_installed_package_makes_the_same_wheel_again(
    wheel: Path, robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (installed,) = robot.parents[1].glob("lib/*/site-packages/vlagents_ray-*.dist-info")
    monkeypatch.setattr(
        importlib.metadata, "distribution", lambda _: importlib.metadata.PathDistribution(installed)
    )
    again = installed_wheel(tmp_path)
    assert again.name == wheel.name
    built, rebuilt = zipfile.ZipFile(wheel), zipfile.ZipFile(again)
    (record,) = (name for name in built.namelist() if name.endswith("/RECORD"))
    assert {name: rebuilt.read(name) for name in rebuilt.namelist() if name != record} == {
        name: built.read(name) for name in built.namelist() if name != record
    }
    assert set(rebuilt.read(record).splitlines()) == set(built.read(record).splitlines())


def test_a_robot_installs_three_packages_and_those_have_no_dependencies_of_their_own(
    robot: Path,
) -> None:
    installed = {
        package["name"]
        for package in json.loads(pip("--python", str(robot), "list", "--format=json"))
    }
    assert installed == {"vlagents-ray"} | LIGHT_DEPENDENCIES


def test_the_robots_side_works_with_those(robot: Path) -> None:
    code = """
import numpy as np
from vlagents_ray import Act, Agent, Obs, RemoteAgent
from vlagents_ray.images.jpeg_png import decode, encode_jpeg
obs = Obs(cameras={"front": np.zeros((8, 8, 3), np.uint8)}, gripper=1.0)
print(decode(encode_jpeg(obs.cameras["front"])).shape)
"""
    assert run(robot, code) == "(8, 8, 3)"


def test_a_robot_has_the_command_that_drives_it(robot: Path) -> None:
    command = [
        robot.with_name("vlagents-ray"),
        "robot",
        "http://127.0.0.1:9",
        "--env",
        "tabletop",
        "--hz",
        "0",
    ]
    ran = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 2
    assert "Error: argument --hz: expected a number above 0, got '0'" in ran.stderr


def test_the_import_takes_half_a_second_at_the_most(robot: Path) -> None:
    # Without the interpreter's start.
    code = "import time, vlagents_ray, vlagents_ray.robot; print(time.process_time())"
    # Next to other processes that compete for the caches, the import takes longer.
    assert any(float(run(robot, code)) < 0.5 for _ in range(10))


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    """Run a server of this checkout without Ray, and yield its URL."""
    command = [sys.executable, str(ROOT / "tests/support/noop_http_server.py"), "127.0.0.1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as server:
        try:
            assert server.stdout is not None
            yield f"http://127.0.0.1:{int(server.stdout.readline())}"
        finally:
            server.terminate()


@pytest.mark.parametrize("transport", ["websocket", "http"])
def test_a_robot_drives_a_server_in_80_mb(robot: Path, url: str, transport: str) -> None:
    code = f"""
import re
import numpy as np
from vlagents_ray import ChunkPlayer, Obs, PlayerSettings, RemoteAgent
from vlagents_ray.robot import run_loop
obs = Obs(cameras={{name: np.zeros((224, 224, 3), np.uint8) for name in ("front", "wrist")}}, gripper=1.0)

class Arm:
    def observe(self):
        return obs
    def apply(self, action):
        assert action.shape == (7,)
    def stop(self):
        pass

with RemoteAgent({url!r}, transport={transport!r}) as agent:
    agent.reset(obs, "stack")
    assert agent.act(obs).action.shape == (7,)
    with ChunkPlayer(agent, PlayerSettings(mode="async", safe="hold")) as player:
        report = run_loop(Arm(), player, hz=50, seconds=0.5)
    assert report.jitter["ticks"] > 0
    print(re.search("VmRSS:[^0-9]*([0-9]+) kB", open("/proc/self/status").read())[1])
"""
    assert int(run(robot, code)) < 80_000


def test_what_a_robot_lacks_is_asked_for_by_the_extra_that_brings_it(
    robot: Path, tmp_path: Path
) -> None:
    code = f"""
from vlagents_ray.errors import MissingDependency
from vlagents_ray.registry import require
from vlagents_ray.robot.record import Recorder
for needed in (lambda: Recorder({str(tmp_path)!r}, 50), lambda: require("ray")):
    try:
        needed()
    except MissingDependency as error:
        print(error)
"""
    assert re.findall(r"pip install 'vlagents-ray\[(\w+)\]'", run(robot, code)) == [
        "record",
        "serve",
    ]


def test_the_help_on_a_robots_computer_names_what_is_there_and_what_to_install(
    robot: Path,
) -> None:
    command = [robot.parent / "vlagents-ray", "--help"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    assert "\n  robot  Drive a robot" in done.stdout
    assert "pip install 'vlagents-ray[serve]'" in " ".join(done.stdout.split())


def test_a_robots_command_says_in_two_lines_what_to_install_for_it(robot: Path) -> None:
    command = [robot.parent / "vlagents-ray", "serve", "noop"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("Error: 'typer' is not installed")
    assert "pip install 'vlagents-ray[serve]'" in done.stderr
    assert done.stderr.count("\n") == 2
