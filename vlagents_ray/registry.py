"""Names of policies and environments, and where their code lives.

A name stands for `"module:Class"`, imported only when it is used. Third parties add names through
the entry-point groups `vlagents_ray.policies`, `vlagents_ray.wrappers` and `vlagents_ray.envs`;
a `"module:Class"` written out in a deployment file works without registration.
"""

from __future__ import annotations

import importlib
import sys
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any

from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv, UnknownPolicy

POLICIES: dict[str, str] = {
    "diffusion_policy": "vlagents_ray.policies.diffusion_policy:DiffusionPolicy",
    "lerobot": "vlagents_ray.policies.lerobot:LeRobot",
    "noop": "vlagents_ray.policies.noop:Noop",
    "octo": "vlagents_ray.policies.octo:Octo",
    "openpi": "vlagents_ray.policies.openpi:OpenPi",
    "openvla": "vlagents_ray.policies.openvla.policy:OpenVLA",
    "openvla_oft": "vlagents_ray.policies.openvla.oft:OpenVLAOFT",
    "pi0": "vlagents_ray.policies.pi0:Pi0",
    "random": "vlagents_ray.policies.random:Random",
    "replay": "vlagents_ray.policies.replay:Replay",
    "scripted": "vlagents_ray.policies.scripted:Scripted",
    "vjepa2_ac": "vlagents_ray.policies.vjepa2_ac:VJepa2Ac",
}

# What changes the observations of any policy: `wrappers` in a deployment file.
WRAPPERS: dict[str, str] = {
    "arro": "vlagents_ray.policies.arro:Arro",
}

# The part of an env's name before the first slash; the rest is the task within it.
ENVS: dict[str, str] = {
    "tabletop": "vlagents_ray.envs.tabletop:Tabletop",
    "maniskill": "vlagents_ray.envs.maniskill:ManiSkill",
    "metaworld": "vlagents_ray.envs.metaworld:MetaWorld",
    "libero": "vlagents_ray.envs.libero:Libero",
    "simpler": "vlagents_ray.envs.simpler:Simpler",
    "gymnasium": "vlagents_ray.envs.gymnasium:Gymnasium",
    "rcs": "vlagents_ray.envs.rcs:Rcs",
    "duobench": "vlagents_ray.envs.rcs:DuoBench",
}

# import name -> extra of this package that installs it
_EXTRAS = {
    "ray": "serve",
    "msgpack": "serve",
    "starlette": "serve",
    "pydantic": "serve",
    "PIL": "serve",
    "yaml": "serve",
    "typer": "serve",
    "rich": "serve",
    "zmq": "gr00t",
    "matplotlib": "bench",
    "gymnasium": "sim",
    "av": "record",
    "pyarrow": "record",
    "mani_skill": "maniskill",
    "sapien": "maniskill",
    "torch": "maniskill",
    "metaworld": "metaworld",
    "libero": "libero",
    "robosuite": "libero",
    "gym_pusht": "pusht",
    "gymnasium_robotics": "robotics",
}

# import name -> its file in requirements/: what runs in a Python environment of its own
_ENVIRONMENTS = {"lerobot": "lerobot.txt", "rcs": "rcs.txt", "duobench": "rcs.txt"}


def require(module: str) -> ModuleType:
    """Import an optional module, or raise `MissingDependency` naming the extra that brings it."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise  # the module is there, something it needs is not: say what
        cure = f"install the package that provides {top!r}"
        if top in _ENVIRONMENTS:
            cure = f"name an environment with requirements/{_ENVIRONMENTS[top]} in the deployment's `environment`"
        elif top in _EXTRAS:
            cure = f"pip install 'vlagents-ray[{_EXTRAS[top]}]'"
        raise MissingDependency(f"{module!r} is not installed; {cure}") from error


def names(kind: str) -> dict[str, str]:
    """All registered names of `kind` ("policies", "wrappers" or "envs") with their "module:Class"."""
    own = {"policies": POLICIES, "wrappers": WRAPPERS, "envs": ENVS}[kind]
    found = {point.name: point.value for point in entry_points(group=f"vlagents_ray.{kind}")}
    return found | own


def policy_class(name: str) -> type[Any]:
    """The Agent class registered as `name`, or written out as "module:Class"."""
    return named_class(name, names("policies"), UnknownPolicy)


def wrapper_class(name: str) -> type[Any]:
    """The Wrapper class registered as `name`, or written out as "module:Class"."""
    return named_class(name, names("wrappers"), UnknownPolicy)


def env_class(name: str) -> type[Any]:
    """The EvalEnv class for `name`, e.g. "tabletop" or "maniskill/PushCube-v1"."""
    return named_class(env_suite(name), names("envs"), UnknownEnv)


def env_suite(name: str) -> str:
    """The registered part of an env's name: "maniskill" of "maniskill/PushCube-v1"."""
    return name if ":" in name else name.partition("/")[0]


def env_task(name: str) -> str | None:
    """The task within the suite: "PushCube-v1" of "maniskill/PushCube-v1"; None if not given."""
    return None if ":" in name else name.partition("/")[2] or None


def named_class(name: str, known: dict[str, str], unknown: type[ConfigError] = ConfigError) -> type[Any]:
    """The class that `known` has under `name`, or written out as "module:Class"; raises `unknown` if there is none."""
    target = known.get(name, name)
    module, colon, attribute = target.partition(":")
    if not colon:
        raise unknown(f"{name!r} is not registered: want one of {sorted(known)}, or 'module:Class'")
    if module.endswith(".py"):
        raise unknown(f"{name!r} names a file: want an importable module, as in 'my_policies:{attribute}'")
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and (module == error.name or module.startswith(error.name + ".")):
            raise unknown(
                f"{name!r}: no module {error.name!r}; install it, or add its folder to PYTHONPATH ({sys.path[0]!r} is)"
            ) from error
        raise MissingDependency(f"{name!r} needs {error.name!r}, which is not installed") from error
    cls = getattr(loaded, attribute, None)
    if not isinstance(cls, type):
        raise unknown(f"{name!r}: module {module!r} has no class {attribute!r}")
    return cls
