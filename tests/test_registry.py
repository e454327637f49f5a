"""Names of policies, wrappers and environments, and the cure for a missing optional package."""

from __future__ import annotations

import ast
import importlib
import json
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import tomllib
from reference import folder_of

import vlagents_ray
from vlagents_ray import registry
from vlagents_ray.envs import graphics
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv, UnknownPolicy
from vlagents_ray.registry import CORE, entries, pip_install

ROOT = Path(vlagents_ray.__file__).parents[1]
FAMILIES = ["diffusion_policy", "gr00t", "hf", "lerobot", "octo", "openpi", "openvla"]
REQUIREMENTS = {name: registry.requirements_file(name).read_text() for name in FAMILIES}


@pytest.fixture
def nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each optional import fail."""

    def missing(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name.partition(".")[0])

    monkeypatch.setattr(importlib, "import_module", missing)


def cure(module: str) -> str:
    with pytest.raises(MissingDependency) as caught:
        registry.require(module)
    return str(caught.value).partition("; ")[2]


def environments_in(text: str) -> list[str]:
    """Return the names for `vlagents-ray venv create` in a cure."""
    _, _, several = text.partition("; NAME is the name of the policy's family: ")
    return several.split(", ") if several else re.findall(r"venv create (\w+)", text)


@pytest.mark.usefixtures("nothing_installed")
@pytest.mark.parametrize(
    ("module", "files"),
    [
        ("torch", ["diffusion_policy", "gr00t", "hf", "lerobot", "openpi", "openvla"]),
        ("transformers", ["gr00t", "hf", "lerobot", "octo", "openpi", "openvla"]),
        ("jax", ["octo", "openpi"]),
        ("diffusers", ["diffusion_policy", "gr00t"]),
        ("openpi.models.model", ["openpi"]),
        ("lerobot.processor", ["lerobot"]),
        ("rcs.envs.base", ["rcs"]),
    ],
)
def test_a_missing_model_package_is_cured_by_its_requirements_file(
    module: str, files: list[str]
) -> None:
    text = cure(module)
    assert "pip install" not in text, "an extra of this package would not install it"
    assert "vlagents-ray venv create " in text
    assert environments_in(text) == files


@pytest.mark.usefixtures("nothing_installed")
def test_a_simulators_environment_is_for_the_workers_and_a_policys_for_its_deployment() -> None:
    assert "py_executable" in cure("rcs")
    assert "deployment's `environment`" in cure("octo.model.octo_model")


@pytest.mark.usefixtures("nothing_installed")
def test_a_missing_simulator_or_runtime_is_cured_by_its_extra() -> None:
    assert cure("mani_skill.envs") == pip_install("maniskill")
    assert cure("onnxruntime") == pip_install("onnx", "vlagents-ray-models")


class InstalledFrom:
    """The distribution of this package, with pip's record of its installation."""

    def __init__(self, record: str | None) -> None:
        self._record = record

    def read_text(self, name: str) -> str | None:
        return self._record if name == "direct_url.json" else None


@pytest.fixture
def installed_from(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str | None], None]]:
    def install(record: str | None) -> None:
        # A checkout on the path has no record.
        found = [InstalledFrom(None), InstalledFrom(record)]
        monkeypatch.setattr(registry.metadata, "distributions", lambda **_: found)
        registry._checkout.cache_clear()

    yield install
    registry._checkout.cache_clear()


@pytest.mark.parametrize("folder", ["plain", "with space"])
@pytest.mark.parametrize("is_editable", [True, False])
def test_what_was_installed_from_a_checkout_is_cured_by_that_checkout(
    installed_from: Callable[[str | None], None], tmp_path: Path, folder: str, is_editable: bool
) -> None:
    checkout = tmp_path / folder
    (checkout / "plugins/vlagents_ray_sims").mkdir(parents=True)
    (checkout / "pyproject.toml").touch()
    info = {"editable": True} if is_editable else {}
    installed_from(json.dumps({"url": checkout.as_uri(), "dir_info": info}))

    options = ["--editable"] if is_editable else []
    sims = f"{checkout}/plugins/vlagents_ray_sims"
    install = ["pip", "install", *options]
    assert shlex.split(pip_install("serve")) == [*install, f"{checkout}[serve]"]
    assert shlex.split(pip_install()) == [*install, f"{checkout}"]
    assert shlex.split(pip_install("libero", "vlagents-ray-sims")) == [*install, f"{sims}[libero]"]
    assert shlex.split(pip_install(distribution="vlagents-ray-sims")) == [*install, sims]
    assert pip_install("arm", "cranes") == "pip install 'cranes[arm]'"  # a third-party plug-in


@pytest.mark.parametrize(
    "record",
    [
        None,
        '{"url": "file:///wheels/vlagents_ray-0.1.0-py3-none-any.whl", "archive_info": {}}',
        '{"url": "file:///no/such/checkout", "dir_info": {"editable": true}}',
    ],
    ids=["index", "archive", "removed"],
)
def test_what_was_installed_without_a_checkout_is_cured_by_a_package_index(
    installed_from: Callable[[str | None], None], record: str | None
) -> None:
    installed_from(record)
    assert pip_install("serve") == "pip install 'vlagents-ray[serve]'"
    assert pip_install(distribution="vlagents-ray-sims") == "pip install vlagents-ray-sims"


def extras_named_in_code() -> set[tuple[str, str]]:
    """Return the arguments (extra, distribution) of all calls of `pip_install`."""
    named = set()
    for source in (*ROOT.glob("vlagents_ray/**/*.py"), *ROOT.glob("plugins/*/*/**/*.py")):
        for node in ast.walk(ast.parse(source.read_text())):
            if not (isinstance(node, ast.Call) and ast.unparse(node.func) == "pip_install"):
                continue
            words = [arg.value for arg in node.args if isinstance(arg, ast.Constant)]
            if words:
                named.add((words[0], words[1] if len(words) > 1 else CORE))
    return named


@pytest.mark.slow
def test_each_extra_that_a_message_names_exists() -> None:
    extras = {}
    for file in (ROOT / "pyproject.toml", *ROOT.glob("plugins/*/pyproject.toml")):
        project = tomllib.loads(file.read_text())["project"]
        extras[project["name"]] = set(project.get("optional-dependencies", ()))
    named = extras_named_in_code()
    assert ("serve", CORE) in named
    assert ("libero", "vlagents-ray-sims") in named
    named |= {(extra, CORE) for extra in registry._EXTRAS}
    for kind in ("policies", "envs", "robots", "exports", "trackers"):
        named |= {
            (entry.extra, entry.distribution) for entry in entries(kind).values() if entry.extra
        }
    assert [(extra, name) for extra, name in sorted(named) if extra not in extras[name]] == []


@pytest.mark.usefixtures("nothing_installed")
def test_a_renderer_that_is_not_installed_is_cured_as_its_simulator_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(graphics.importlib.util, "find_spec", lambda _: None)
    assert graphics.egl_probe.__wrapped__().cure == cure("mujoco")
    assert graphics.render_probe.__wrapped__().cure == cure("sapien")


@pytest.mark.usefixtures("nothing_installed")
def test_a_package_that_no_requirements_file_installs_is_cured_by_pip() -> None:
    assert "`pip install torchao` in the policy's environment" in cure("torchao.quantization")


def required() -> Iterator[str]:
    """Return the top-level packages that the code imports through `require`."""
    packages = (ROOT / "vlagents_ray", ROOT / "plugins/vlagents_ray_models/vlagents_ray_models")
    for path in (path for package in packages for path in package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Call(func=ast.Name("require"), args=[ast.Constant(str(module))]):
                    yield module.partition(".")[0]


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_installed")
def test_every_optional_package_has_a_cure() -> None:
    assert [
        name for name in sorted(set(required())) if cure(name).startswith("install the package")
    ] == []


def test_the_extras_and_files_that_cures_name_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert set(registry._EXTRAS.keys()) <= extras.keys()
    registered = (registry.entries("policies") | registry.entries("envs")).values()
    for entry in registered:
        project = tomllib.loads((ROOT / folder_of(entry) / "pyproject.toml").read_text())["project"]
        assert entry.extra is None or entry.extra in project["optional-dependencies"]
    assert {
        one.requirements[0] for one in registry.entries("policies").values() if one.requirements
    } == set(FAMILIES)
    for file in {file for entry in registered for file in entry.requirements}:
        assert registry.requirements_file(file).exists()


@pytest.mark.parametrize("package", ["torch", "transformers", "jax", "flax", "timm"])
@pytest.mark.usefixtures("nothing_installed")
def test_a_cure_names_each_file_that_lists_the_package(package: str) -> None:
    listed = [name for name in FAMILIES if re.search(rf"(?m)^{package}\b(?!-)", REQUIREMENTS[name])]
    assert set(listed) <= set(environments_in(cure(package)))


def test_an_unknown_name_raises_the_error_of_its_kind() -> None:
    with pytest.raises(
        UnknownPolicy, match=r"'scriptd', which is not registered.*did you mean 'scripted'"
    ):
        registry.policy_class("scriptd")
    with pytest.raises(
        UnknownEnv, match=r"'tabletopp', which is not registered.*did you mean 'tabletop'"
    ):
        registry.env_class("tabletopp/reach")


def test_requirements_are_found_in_the_package_that_registers_them_and_others_are_refused() -> None:
    assert registry.requirements_file("hf").parent.parent.name == "vlagents_ray_models"
    assert registry.requirements_file("rcs").parent.parent.name == "vlagents_ray_sims"
    with pytest.raises(
        ConfigError, match=r"requirements 'lerobt': expected a file.*did you mean 'lerobot'"
    ):
        registry.requirements_file("lerobt")


def test_requirements_of_a_plugin_that_is_not_installed_are_an_error_that_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "published", lambda: {"policies": {"pi9": "vlagents-ray-more"}})
    with pytest.raises(ConfigError, match="more are in vlagents-ray-more, not installed here"):
        registry.requirements_file("pi9")
