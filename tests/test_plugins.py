"""Plug-ins: the registrations of a distribution, and the messages about broken or missing ones."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from vlagents_ray import registry
from vlagents_ray.cli import doctor, robot
from vlagents_ray.cli.listing import policies_and_wrappers
from vlagents_ray.cli.main import app
from vlagents_ray.cli.results import settings_of_export
from vlagents_ray.errors import ConfigError, UnknownEnv, UnknownPolicy
from vlagents_ray.registry import (
    RegistryEntry,
    entries,
    find_entry,
    names,
    not_installed,
    plugin_distributions,
)
from vlagents_ray.robot.leaders import leader_named
from vlagents_ray.robot.loop import robot_factory

Install = Callable[..., None]

POLICY = """
\"\"\"A policy of a plug-in.\"\"\"
from vlagents_ray.policies.noop import Noop

class Mine(Noop):
    pass
"""
REGISTRY = """
from vlagents_ray.registry import RegistryEntry

MINE = RegistryEntry("lab_policies.mine:Mine", "models of the lab", page="https://example.org/mine")
NO_ENTRY = "lab_policies.mine:Mine"
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that installs a distribution with the given entry points by group; its
    package is `lab_policies`.
    """
    package = tmp_path / "lab_policies"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "mine.py").write_text(POLICY.replace('\\"', '"'))
    (package / "registry.py").write_text(REGISTRY)
    (package / "broken.py").write_text("import no_such_package\n")

    def write(distribution: str, **groups: str) -> None:
        info = tmp_path / f"{distribution.replace('-', '_')}-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1\n")
        lines = [f"[vlagents_ray.{group}]\n{line}\n" for group, line in groups.items()]
        (info / "entry_points.txt").write_text("".join(lines))
        registry._installed_entry_points.cache_clear()

    monkeypatch.syspath_prepend(tmp_path)
    for module in [name for name in sys.modules if name.partition(".")[0] == "lab_policies"]:
        # The module may come from the folder of another test.
        monkeypatch.delitem(sys.modules, module)
    yield write
    registry._installed_entry_points.cache_clear()


def test_a_plugins_entry_carries_what_a_built_in_one_does(install: Install) -> None:
    install("lab-policies", policies="mine = lab_policies.registry:MINE")
    entry = find_entry("policies", "mine")
    assert entry is not None
    assert (entry.about, entry.page, entry.distribution) == (
        "models of the lab",
        "https://example.org/mine",
        "lab-policies",
    )
    assert "mine" in names("policies")
    assert "lab-policies" in plugin_distributions()
    [listed] = [row for row in policies_and_wrappers() if row.name == "mine"]
    assert (listed.kind, listed.what, listed.missing) == ("policy", "models of the lab", None)


def test_a_built_in_name_is_not_replaced(
    install: Install, caplog: pytest.LogCaptureFixture
) -> None:
    install("lab-policies", policies="noop = lab_policies.registry:MINE")
    entry = find_entry("policies", "noop")
    assert entry is not None
    assert entry.distribution == registry.CORE
    names("policies")
    assert "lab-policies registers 'noop', a name of vlagents-ray" in caplog.text


def test_a_built_in_command_is_not_replaced(
    install: Install, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lab_policies" / "command.py").write_text("def run(): raise SystemExit(7)\n")
    with (tmp_path / "lab_policies" / "registry.py").open("a") as file:
        file.write("COMMAND = RegistryEntry('lab_policies.command:run')\n")
    install("lab-policies", commands="keys = lab_policies.registry:COMMAND")
    command = [sys.executable, "-m", "vlagents_ray", "keys"]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(tmp_path)}, check=False)
    assert done.returncode != 7
    assert "lab-policies registers 'keys', a name of vlagents-ray" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "lab_policies.registry:NO_ENTRY",
            r"expected 'mine' of lab-policies to name a RegistryEntry.* a str; write",
        ),
        ("lab_policies.mine:Mine", r"got lab_policies.mine:Mine, a type; write"),
        ("lab_policies.registry:GONE", r"importing lab_policies.registry:GONE failed"),
        (
            "lab_policies.broken:MINE",
            r"importing .* failed: No module named 'no_such_package'; update that package",
        ),
    ],
)
def test_a_plugin_that_cannot_be_loaded_is_named_and_hides_no_other(
    install: Install, value: str, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    install("lab-policies", policies=f"mine = {value}")
    with pytest.raises(ConfigError, match=message):
        registry.policy_class("mine")
    assert "noop" in entries("policies")
    assert "mine" not in entries("policies")
    assert "lab-policies" in caplog.text
    [listed] = [row for row in policies_and_wrappers() if row.name == "mine"]
    assert listed.missing is not None
    assert "lab-policies" in listed.missing


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            "lab_policies.registry:COMMAND",
            "command 'lab' of lab-policies cannot be loaded: out of order",
        ),
        ("lab_policies.broken:COMMAND", "lab-policies to name a RegistryEntry"),
    ],
)
def test_a_command_that_cannot_be_loaded_is_an_error_that_names_its_plugin(
    install: Install, tmp_path: Path, value: str, message: str
) -> None:
    (tmp_path / "lab_policies" / "command.py").write_text("raise ImportError('out of order')\n")
    with (tmp_path / "lab_policies" / "registry.py").open("a") as file:
        file.write("COMMAND = RegistryEntry('lab_policies.command:run')\n")
    install("lab-policies", commands=f"lab = {value}")
    with pytest.raises(ConfigError, match=message):
        registry.registered_function("commands", "lab")


def test_a_policy_whose_module_raises_is_listed_with_its_error(
    install: Install, tmp_path: Path
) -> None:
    (tmp_path / "lab_policies" / "mine.py").write_text("raise RuntimeError('out of order')\n")
    install("lab-policies", policies="mine = lab_policies.registry:MINE")
    with pytest.raises(
        ConfigError, match="policy 'mine' of lab-policies cannot be loaded: out of order"
    ):
        registry.policy_class("mine")
    [listed] = [row for row in policies_and_wrappers() if row.name == "mine"]
    assert "out of order" in str(listed.missing)


EXPORT = """
def write(results, path, *, limit: int = 3, columns: list[str]) -> int:
    return 0
"""


def test_a_format_of_the_user_has_the_settings_of_its_function(
    install: Install, tmp_path: Path
) -> None:
    (tmp_path / "lab_policies" / "export.py").write_text(EXPORT)
    install("lab-policies")
    export = registry.registered_function("exports", "lab_policies.export:write")
    assert settings_of_export("lab", export, ["limit=2", "columns=[env]"]) == {
        "limit": 2,
        "columns": ["env"],
    }
    wrong = {
        "limt=2": "limt: there is no such setting; expected one of .*; did you mean 'limit'",
        "limit=many": "limit: expected a valid integer, got 'many'",
        "columns=env": r"columns: expected a valid list, such as \[env\], got 'env'",
        "limit=2": "columns: is missing; add --set columns=",
    }
    for setting, message in wrong.items():
        with pytest.raises(ConfigError, match=f"--set, for --to lab: (?s:.*){message}"):
            settings_of_export("lab", export, [setting])


def test_a_name_of_two_distributions_is_an_error_that_names_both(install: Install) -> None:
    install("lab-policies", policies="mine = lab_policies.registry:MINE")
    install("other-lab", policies="mine = lab_policies.registry:OTHER")
    with pytest.raises(
        ConfigError,
        match=(
            r"expected .* once in .*, got it from lab-policies and other-lab; uninstall one of "
            r"them"
        ),
    ):
        registry.policy_class("mine")


def test_a_name_of_a_plugin_that_is_not_installed_is_an_error_that_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published = {
        "envs": {"shelf": "vlagents-ray-shelf"},
        "policies": {"pi9": "vlagents-ray-models"},
    }
    monkeypatch.setattr(registry, "published", lambda: published)
    absent = RegistryEntry("no_such_tables:Any", distribution="vlagents-ray-tables")
    monkeypatch.setitem(registry.EXPORTS, "hdf9", absent)
    monkeypatch.setitem(registry.TRACKERS, "notebook9", absent)
    with pytest.raises(
        UnknownEnv, match="'shelf' is in vlagents-ray-shelf, which is not installed: pip install"
    ):
        registry.env_class("shelf/top")
    with pytest.raises(UnknownPolicy, match="policy 'pi9' is in vlagents-ray-models"):
        registry.policy_class("pi9")
    with pytest.raises(ConfigError, match="export format 'hdf9' is in vlagents-ray-tables"):
        registry.registered_function("exports", "hdf9")
    with pytest.raises(ConfigError, match="tracker 'notebook9' is in vlagents-ray-tables"):
        registry.registered_class("trackers", "notebook9")
    assert "hdf9" not in entries("exports")
    assert not_installed("exports") == {"hdf9": "vlagents-ray-tables"}
    with pytest.raises(ConfigError, match="a page is in vlagents-ray-tables, which is not inst"):
        registry.function_in_plugin("a page", absent.target, absent.distribution)
    [listed] = [row for row in policies_and_wrappers() if row.name == "pi9"]
    assert listed.what == "in vlagents-ray-models"
    assert (
        listed.missing
        == f"not installed: {registry.pip_install(distribution='vlagents-ray-models')}"
    )


def test_all_plugins_of_this_repository_are_installed_for_its_tests() -> None:
    for kind in ("policies", "wrappers", "envs", "dialects"):
        assert not_installed(kind) == {}, "make setup"
        for name in names(kind):
            assert find_entry(kind, name) is not None


@pytest.mark.parametrize("kind", ["exports", "trackers", "leaders"])
def test_what_this_package_names_in_plugins_of_this_repository_is_there(kind: str) -> None:
    assert not_installed(kind) == {}, "make setup"
    for name in names(kind):
        assert callable(registry.registered_function(kind, name))


ROBOTS = """
class Arm:
    def __init__(self, name):
        self.name = name

    observe = apply = stop = lambda *_: None


class Lamp:
    def __init__(self, name): ...


class Pedal:
    help = "press it"

    def __init__(self):
        self.open = True

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.open = False

    def engaged(self):
        return False

    def action(self, obs): ...


def inspect(arguments):
    print("inspecting", *arguments)
    return 7
"""
ROBOT_REGISTRY = """
ARM = RegistryEntry("lab_policies.robots:Arm", "the arm of the lab", tasks=":<name>")
LAMP = RegistryEntry("lab_policies.robots:Lamp")
INSPECT = RegistryEntry("lab_policies.robots:inspect", "Inspect the arm.")
"""


@pytest.fixture
def lab(install: Install, tmp_path: Path) -> None:
    """Install a distribution with a robot and a subcommand of `vlagents-ray robot`, and a class of
    a leader.
    """
    (tmp_path / "lab_policies" / "robots.py").write_text(ROBOTS)
    with (tmp_path / "lab_policies" / "registry.py").open("a") as file:
        file.write(ROBOT_REGISTRY)
    install(
        "lab-robots",
        robots="arm = lab_policies.registry:ARM\nlamp = lab_policies.registry:LAMP",
        commands="robot.inspect = lab_policies.registry:INSPECT",
    )


@pytest.mark.usefixtures("lab")
def test_a_robot_of_a_plugin_is_made_by_its_name_with_the_text_after_the_colon() -> None:
    assert vars(robot_factory("--robot", "arm:left")()) == {"name": "left"}
    with pytest.raises(
        ConfigError,
        match=r"--robot lamp:left: expected a class with observe.*, got a class without observe, apply, stop",
    ):
        robot_factory("--robot", "lamp:left")


@pytest.mark.usefixtures("lab")
def test_a_leader_of_the_user_is_opened_by_the_name_of_its_class_and_closed() -> None:
    opened = leader_named("--teleop", "lab_policies.robots:Pedal")(None, step=0.5, measure=None)
    with opened as leader:
        assert leader.open  # type: ignore[attr-defined]
    assert not leader.open  # type: ignore[attr-defined]


@pytest.mark.usefixtures("lab")
def test_a_subcommand_of_a_plugin_gets_its_arguments_and_is_no_command_of_its_own(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert robot.main(["inspect", "arm:left", "--fast"]) == 7
    assert capsys.readouterr().out == "inspecting arm:left --fast\n"
    with pytest.raises(SystemExit):
        robot.main(["--help"])
    listed = capsys.readouterr().out
    for name, about in (
        ("inspect", "Inspect the arm."),
        ("arm:<name>", "the arm of the lab"),
        ("keyboard", "the keys of the terminal as six axes and a gripper"),
    ):
        assert re.search(rf"^  {name} +{about}$", listed, re.MULTILINE), name
    assert not [command.name for command in app.registered_commands if "." in str(command.name)]


def test_a_robot_a_leader_and_a_subcommand_that_are_not_installed_name_their_distribution(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    published = {
        "robots": {"crane": "vlagents-ray-cranes"},
    }
    wheel = RegistryEntry("no_such_cranes:open_wheel", distribution="vlagents-ray-cranes")
    monkeypatch.setitem(registry.LEADERS, "wheel", wheel)
    published["commands"] = {"robot.lift": "vlagents-ray-cranes"}
    monkeypatch.setattr(registry, "published", lambda: published)
    with pytest.raises(
        ConfigError,
        match="robot 'crane' is in vlagents-ray-cranes, which is not installed: pip inst",
    ):
        robot_factory("--robot", "crane:4")
    with pytest.raises(
        ConfigError, match="leader 'wheel' is in vlagents-ray-cranes, which is not installed"
    ):
        leader_named("--teleop", "wheel")
    assert robot.main(["lift", "crane:4"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "Error: ConfigError: command 'robot lift' is in vlagents-ray-cranes, which is not "
        "installed: pip "
    )
    with pytest.raises(SystemExit):
        robot.main(["--help"])
    assert re.search(
        r"^  crane +not installed: pip install vlagents-ray-cranes$",
        capsys.readouterr().out,
        re.MULTILINE,
    )
    monkeypatch.setattr(doctor, "published", lambda: published)
    assert doctor.plugins().detail.endswith("; not installed: vlagents-ray-cranes")


# Prints the exit status and the output of each command of this repository's plug-ins, with no
# plug-in installed.
WITHOUT_PLUGINS = """
import contextlib, importlib.metadata, io, json

importlib.metadata.entry_points = lambda **_: ()

from typer.testing import CliRunner
from vlagents_ray.cli.main import app
from vlagents_ray.registry import published

ended = {}
for command in published()["commands"]:
    with contextlib.redirect_stderr(io.StringIO()) as stderr:
        done = CliRunner().invoke(app, [*command.split("."), "runs/x", "--out", "y"])
    ended[command] = done.exit_code, done.output + stderr.getvalue()
print(json.dumps(ended))
"""


def test_each_command_of_a_plugin_that_is_not_installed_names_its_distribution() -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PLUGINS],
        cwd=Path(registry.__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    ended = json.loads(done.stdout.splitlines()[-1])
    assert ended.keys() == registry.published()["commands"].keys()
    for command, distribution in registry.published()["commands"].items():
        status, output = ended[command]
        assert status == 2
        words = " ".join(output.split())
        assert f"command {command.replace('.', ' ')!r} is in {distribution}" in words
        assert registry.pip_install(distribution=distribution) in words
