"""Third-party programs and the outcomes of their tests; the site shows them in docs/programs.md.

A test that runs a program is marked `@pytest.mark.program(NAME)` with a name in `PROGRAMS`. `make
programs` runs these tests with `pytest --verified`, which records the outcomes and the versions in
`programs.json`.
"""

from __future__ import annotations

import json
import os
import platform
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import distributions
from typing import TYPE_CHECKING, Any

from verified import ROOT, installed_version

if TYPE_CHECKING:
    import pytest  # the environment that builds the site has none

NOTED = ROOT / "tests" / "programs.json"
PYPI = "PyPI"
# Folders with packages that use the torch of .venv.
BESIDE = {"stable-baselines3": "STABLE_BASELINES3_SRC", "torchrl": "TORCHRL_SRC"}


@dataclass(frozen=True)
class Program:
    """A third-party program.

    A program with `requirements` has an environment with these packages. A function of
    `program_clients.py` runs it with a server that has `dialects`.
    """

    packages: tuple[str, ...]  # the packages whose versions matter, or the variable of a checkout
    connects: str  # the dialect or interface through which the program connects
    source: str = PYPI
    said: str = ""  # further settings or advice for the docs, besides `dialects`
    requirements: tuple[str, ...] = ()
    python: str = "3.11"
    client: str = ""  # the name of the function in `program_clients.py`
    dialects: Mapping[str, Any] = field(default_factory=dict)
    dim: int = 7  # number of values in an action
    used: int = 4  # number of rows of a chunk that the program executes
    options: tuple[str, ...] = ()  # options of `uv pip install`


def _adapter(name: str, version: str, *more: str) -> tuple[str, ...]:
    return (f"inspect-robots-{name}=={version}", "inspect-robots==0.60.0", *more)


# typing_extensions is imported by openpi-client, but missing in its requirements
_OPENPI = ("openpi-client==0.1.2", "typing_extensions")
_CAMERAS = {"front": "top_cam", "left": "left_cam", "right": "right_cam"}
_A2 = {
    "cameras": {
        "front": "observation/head_image",
        "left": "observation/left_image",
        "right": "observation/right_image",
    },
    "state": {"joints": "observation/joint_position"},
    "instruction": "prompt",
}
_GO1 = {
    "cameras": {"front": "top", "left": "left", "right": "right"},
    "state": {"joints": "state"},
    "instruction": "instruction",
}
_YAM = {
    "cameras": _CAMERAS,
    "state": {"joints": "state"},
    "instruction": "instruction",
    "action": {"actions": {}},
}
_G1 = {
    "left_arm": {"stop": 7},
    "left_hand": {"start": 7, "stop": 8},
    "right_arm": {"start": 8, "stop": 15},
    "right_hand": {"start": 15},
}
_POSE = {
    name: {"start": i, "stop": i + 1}
    for i, name in enumerate(("x", "y", "z", "roll", "pitch", "yaw", "gripper"))
}

PROGRAMS = {
    "openpi-client": Program(
        ("openpi-client",), "openpi", said="0.1.2 also needs `typing_extensions`"
    ),
    "openpi examples/simple_client": Program(
        ("OPENPI_SRC", "openpi-client"),
        "openpi",
        "GitHub",
        "a preset for each `--env`; only applications at the root",
        requirements=_OPENPI,
    ),
    "openpi examples/aloha_sim": Program(
        ("OPENPI_SRC", "openpi-client"), "openpi", "GitHub", requirements=_OPENPI
    ),
    "RoboArena's messages": Program(
        ("openpi-client",),
        "roboarena",
        said="openpi's client with RoboArena's requests; theirs is on no index",
    ),
    "OpenVLA's `requests` and json-numpy": Program(("json-numpy",), "openvla"),
    "vla-eval": Program(("vla-eval",), "vla_eval", said="`server.url` ends in `/vla-eval`"),
    "vlagents": Program(
        ("vlagents",), "vlagents", said="a port; `model` is the application's name"
    ),
    "LeRobot asynchronous inference": Program(("lerobot",), "lerobot", said="a port"),
    "LeRobot lerobot-record": Program(
        ("lerobot",),
        "plug-in",
        said="without a teleoperator: `--dataset.reset_time_s=0`; 0.6 takes no policy",
    ),
    "LeRobot lerobot-eval": Program(
        ("lerobot",), "plug-in", said="0.6: `--eval.use_async_envs=false`"
    ),
    "LeRobot lerobot-rollout with RTC": Program(
        ("lerobot",), "plug-in", said="0.6; a policy with real-time chunking"
    ),
    "Gymnasium's checkers": Program(("gymnasium",), "`as_vector_env`"),
    "Stable-Baselines3": Program(
        ("stable-baselines3",),
        "`as_vector_env`",
        said="the wrapper of `docs/evaluation/stable_baselines.py`",
    ),
    "TorchRL": Program(
        ("torchrl",), "`as_vector_env`", said='`GymWrapper(as_vector_env(…, autoreset="disabled"))`'
    ),
    "inspect-robots-franka": Program(
        ("inspect-robots-franka", "inspect-robots", "openpi-client"),
        "openpi",
        client="franka",
        dim=8,
        said="for positions: `actions_are_velocity=False`",
        requirements=_adapter("franka", "0.1.0", *_OPENPI),
        dialects={"openpi": {"mapping": "openpi-droid"}},
    ),
    "inspect-robots-widowx openpi": Program(
        ("inspect-robots-widowx", "inspect-robots", "openpi-client"),
        "openpi",
        client="widowx_openpi",
        requirements=_adapter("widowx", "0.1.0", *_OPENPI),
        dialects={
            "openpi": {
                "mapping": {
                    "cameras": {"front": "observation/image"},
                    "instruction": "prompt",
                    "action_gripper": {"index": 6},
                }
            }
        },
    ),
    "inspect-robots-widowx openvla": Program(
        ("inspect-robots-widowx", "inspect-robots"),
        "openvla",
        client="widowx_openvla",
        used=1,
        requirements=_adapter("widowx", "0.1.0", *_OPENPI),
        dialects={"openvla": {}},
    ),
    "inspect-robots-agibot-a2 openpi": Program(
        ("inspect-robots-agibot-a2", "inspect-robots", "openpi-client"),
        "openpi",
        client="agibot_openpi",
        dim=16,
        requirements=_adapter("agibot-a2", "0.1.0", *_OPENPI),
        dialects={"openpi": {"mapping": _A2}},
    ),
    "inspect-robots-agibot-a2 GO-1": Program(
        ("inspect-robots-agibot-a2", "inspect-robots"),
        "openvla",
        client="agibot_go1",
        dim=16,
        requirements=_adapter("agibot-a2", "0.1.0", *_OPENPI),
        dialects={"openvla": {"chunk": True, "plain": True, "mapping": _GO1}},
    ),
    "inspect-robots-yam (MolmoAct2)": Program(
        ("inspect-robots-yam", "inspect-robots"),
        "openvla",
        client="yam",
        dim=14,
        requirements=_adapter("yam", "0.37.0"),
        dialects={"openvla": {"chunk": True, "mapping": _YAM}},
    ),
    "inspect-robots-unitree-g1": Program(
        ("inspect-robots-unitree-g1", "inspect-robots"),
        "gr00t",
        client="unitree_g1",
        dim=16,
        requirements=_adapter("unitree-g1", "0.1.1", "msgpack", "msgpack-numpy", "pyzmq"),
        dialects={"gr00t": {"mapping": {"preset": "gr00t", "action": _G1}}},
    ),
    "inspect-robots-xpolicylab": Program(
        ("inspect-robots-xpolicylab", "inspect-robots"),
        "xpolicylab",
        client="xpolicylab",
        dim=14,
        said="its `url` ends in `/xpolicylab`",
        requirements=_adapter("xpolicylab", "0.1.0"),
        dialects={"xpolicylab": {}},
    ),
    "strands-robots Cosmos 3": Program(
        ("strands-robots",),
        "openpi",
        client="strands_robots",
        dim=8,
        python="3.12",
        requirements=("strands-robots[cosmos3-service]==0.5.3",),
        dialects={"openpi": {"mapping": {"preset": "openpi-droid", "action": {"action": {}}}}},
    ),
    "strands-robots-sim GR00T N1.5": Program(
        ("strands-robots-sim",),
        "gr00t",
        client="strands_robots_sim",
        requirements=("strands-robots-sim==0.1.1", "msgpack", "pyzmq", "numpy"),
        options=("--no-deps",),
        dialects={"gr00t": {"mapping": {"preset": "gr00t-n1.5", "action": _POSE}}},
    ),
    "positronic RoboArena": Program(
        ("positronic", "positronic-wire"),
        "roboarena",
        client="positronic",
        dim=8,
        said="numbers cameras from 1",
        options=("--no-deps",),
        requirements=(
            "positronic==0.4.1",
            "positronic-wire==0.12.0",
            "positronic-model-server==0.3.1",
            "positronic-eval-vocabulary==0.6.0",
            "boto3",
            "botocore",
            "jmespath",
            "msgpack",
            "msgpack-numpy",
            "numpy",
            "opentelemetry-api",
            "pillow",
            "pos3",
            "python-dateutil",
            "pyyaml",
            "s3transfer",
            "six",
            "tqdm",
            "typing-extensions",
            "urllib3",
            "websockets",
        ),
        dialects={"roboarena": {"mapping": "openpi-droid", "action_space": "joint_position"}},
    ),
    "provael": Program(
        ("provael", "openpi-client"),
        "openpi",
        client="provael",
        python="3.12",
        used=1,
        said="executes the first row of each chunk",
        requirements=("provael[openpi]==0.46.0", *_OPENPI),
        dialects={"openpi": {"mapping": "openpi-libero"}},
    ),
}


class RunPrograms:
    """A pytest plugin that records the outcomes of the tests marked `program`, by program and
    version.
    """

    def __init__(self) -> None:
        self._outcomes: dict[str, Counter[str]] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            for mark in item.iter_markers("program"):
                item.user_properties.append(("program", mark.args[0]))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = dict(report.user_properties).get("program")
        if name is not None and (report.when == "call" or report.outcome != "passed"):
            self._outcomes.setdefault(str(name), Counter())[report.outcome] += 1

    def pytest_sessionfinish(self) -> None:
        noted = notes()
        for name, outcomes in self._outcomes.items():
            if outcomes.keys() != {"skipped"}:
                program = PROGRAMS[name]
                noted.setdefault(name, {})[_python(program)] = {
                    "versions": versions(program),
                    **outcomes,
                }
        if self._outcomes:
            NOTED.write_text(
                json.dumps({name: noted[name] for name in PROGRAMS if name in noted}, indent=2)
                + "\n"
            )


def notes() -> dict[str, dict[str, dict[str, Any]]]:
    """Return the recorded outcomes of each program, by Python version."""
    found: dict[str, dict[str, dict[str, Any]]] = (
        json.loads(NOTED.read_text()) if NOTED.is_file() else {}
    )
    return found


def versions(program: Program) -> str:
    """Return the versions of a program's packages for the table."""
    pinned = _pins(program)
    found = {name: pinned.get(name) or _installed(name) for name in program.packages}
    return ", ".join(
        f"{name.removesuffix('_SRC').lower()} {number}" for name, number in found.items()
    )


def _pins(program: Program) -> dict[str, str]:
    """Return the pinned versions in a program's environment, or in the environment of the peers'
    clients, by package.
    """
    wanted = (
        list(program.requirements)
        or (ROOT / "benchmarks/peers/requirements.txt").read_text().splitlines()
    )
    pins = (line.partition("==") for line in wanted)
    return {name.partition("[")[0]: number for name, equal, number in pins if equal}


def _installed(name: str) -> str:
    if name in BESIDE:
        return next(iter(distributions(name=name, path=[os.environ[BESIDE[name]]]))).version
    return installed_version(name)


def _python(program: Program) -> str:
    return program.python if program.requirements else ".".join(platform.python_version_tuple()[:2])
