"""CALVIN: chains of five tasks, each with an instruction, at a table with a drawer, a door, lights
and blocks.
"""

from __future__ import annotations

import ast
import contextlib
import copy
import functools
import importlib
import io
import itertools
import logging
import math
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs import graphics
from vlagents_ray.envs.graphics import EGL_CURE, EGL_DEVICE, Renderer
from vlagents_ray.envs.simulator import BenchmarkProtocol, SimulatorEnv, without
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import Obs
from vlagents_ray.ray_tools.git_state import code_in
from vlagents_ray.registry import require

NUMBER = 1000  # the number of chains in the evaluation
_LENGTH = 5  # tasks in a chain


@dataclass(frozen=True, slots=True)
class Chain:
    """The tasks and the initial state of an episode."""

    tasks: tuple[str, ...]  # CALVIN's names, e.g. "open_drawer"
    robot: np.ndarray  # (15,) CALVIN's `robot_obs`
    scene: np.ndarray  # (24,) CALVIN's `scene_obs`


class Chains:
    """The chains by their number, in the order of CALVIN's `get_sequences(1000)`.

    For each of 192 initial states, each with its own seed, CALVIN draws tasks at random until it
    has enough feasible sequences. Drawing all of them takes minutes. Here, the sequences of a state
    are drawn when one of them is requested.
    """

    def __init__(self, checkout: Path) -> None:
        """Read the rules and the order of the chains from a checkout of CALVIN."""
        evaluation = checkout / "calvin_models/calvin_agent/evaluation"
        utils = _definitions(
            evaluation / "utils.py",
            contextlib=contextlib,
            logging=logging,
            np=np,
            pi=math.pi,
            pyhash=SimpleNamespace(fnv1_32=lambda: fnv1_32),
        )
        self._state_of = utils["get_env_state_for_initial_condition"]
        self._rules = rules = _definitions(
            evaluation / "multistep_sequences.py",
            ProcessPoolExecutor=_no_processes,
            deepcopy=copy.deepcopy,
            functools=functools,
            logging=logging,
            multiprocessing=multiprocessing,
            np=np,
            product=itertools.product,
            temp_seed=utils["temp_seed"],
        )
        # For each chain: the initial state, its seed, and the index among the chains of the state.
        self._order: list[tuple[Mapping[str, Any], tuple[int, int]]] = rules["get_sequences"](
            NUMBER
        )
        # For each seed of a state: its random generator, and the feasible sequences that have been
        # drawn.
        self._drawn: dict[int, tuple[np.random.RandomState, list[tuple[str, ...]]]] = {}

    def __getitem__(self, number: int) -> Chain:
        """Return the chain with this number, 0 to `NUMBER` - 1."""
        state, (seed, index) = self._order[number]
        names, is_feasible = list(self._rules["tasks"]), self._rules["check_sequence"]
        generator, sequences = self._drawn.setdefault(seed, (np.random.RandomState(seed), []))
        while len(sequences) <= index:
            # This draws the same values as CALVIN's `choice` without replacement.
            drawn = generator.permutation(len(names))[:_LENGTH]
            sequence = tuple(names[i] for i in drawn)
            if is_feasible(state, sequence):
                sequences.append(sequence)
        return Chain(sequences[index], *self._state_of(state))


def _no_processes(max_workers: int) -> contextlib.AbstractContextManager[SimpleNamespace]:  # noqa: ARG001
    """Replace CALVIN's `ProcessPoolExecutor`, whose processes would draw all chains."""
    return contextlib.nullcontext(SimpleNamespace(map=_chain_indices))


def _chain_indices(
    _: Callable[..., Any], jobs: Iterable[tuple[Any, int, int]]
) -> list[list[np.ndarray]]:
    """Return, for each state, the seed and the index of each of its chains, in place of the chains.

    Each job in `jobs` contains a state, the number of its chains, and its seed.
    """
    indices = []
    for _state, count, seed in jobs:
        indices.append([np.array([seed, index]) for index in range(count)])
    return indices


def fnv1_32(text: str) -> int:
    """Return pyhash's FNV-1 hash, whose initial value is 0 and whose prime is 0x01000193."""
    digest = 0
    for byte in text.encode():
        digest = (digest * 0x01000193 % 2**32) ^ byte
    return digest


def _definitions(path: Path, **imported: Any) -> dict[str, Any]:
    """Execute a module of the checkout without its imports, and return its names.

    `imported` contains the objects that the module would import, by name.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    tree.body = [node for node in tree.body if not isinstance(node, ast.Import | ast.ImportFrom)]
    names = {"__name__": path.stem, **imported}
    exec(compile(tree, str(path), "exec"), names)  # noqa: S102 - it is the simulator's code, which is run in any case
    return names


VARIABLE = "CALVIN_SRC"
_CURE = (
    f"git clone --recurse-submodules https://github.com/mees/calvin, and set {VARIABLE} on every "
    "node, or the env's option `source_dir`, to that folder"
)
RendererName = Literal["egl", "tiny"]
_PACKAGE, _CONF = Path("calvin_env"), Path("calvin_env/conf")
_TASKS = Path("calvin_models/conf/callbacks/rollout/tasks/new_playtable_tasks.yaml")
_WORDS = Path("calvin_models/conf/annotations/new_playtable_validation.yaml")
SCENES = ("A", "B", "C", "D")
# Tasks per episode, and the limit of steps per task: evaluate_policy.py, EP_LEN.
TASKS, STEPS = 5, 360
PROTOCOL = BenchmarkProtocol(
    name="CALVIN",
    source="Mees et al. 2022, arXiv 2112.03227; calvin_agent/evaluation/evaluate_policy.py at "
    "fa03f01",
    max_steps=TASKS * STEPS,
    control_hz=30.0,
    control="pose of the tool, relative: 0.02 m and 0.05 rad a unit, added to the last target",
    success="all five tasks are solved in order, each within 360 steps",
    metric="success_once",
    begins="one of 1000 chains of five tasks, with its initial state; the arm always starts in "
    "the same pose",
    ends_on_success=True,
    episodes=NUMBER,
)
_CAMERAS = {"static": CameraSpec(200, 200), "gripper": CameraSpec(84, 84)}
# The content of CALVIN's `robot_obs`, (15,), in order. Its last value, which is not part of the
# state, is the gripper's command.
_STATE = {
    "tcp_pos": StateSpec(3, "m"),
    "tcp_orn": StateSpec(3, "rad"),
    "gripper_opening_width": StateSpec(1, "m"),
    "robot_joints": StateSpec(7, "rad"),
}
CONTRACT = Contract(
    cameras=_CAMERAS,
    state=_STATE,
    gripper=True,
    instruction=True,
    action=ActionSpec(
        dim=7,
        space="ee_pose",
        delta=True,
        rotation="euler_xyz",
        gripper_open=1.0,
        gripper_closed=-1.0,
    ),
    control_hz=PROTOCOL.control_hz,
)


class Calvin(SimulatorEnv):
    """One scene of CALVIN, "A" to "D", in which an episode is a chain of five tasks.

    Observation: the cameras `static`, 200x200, and `gripper`, 84x84. `gripper` is the last command,
    1 = open. `state` contains:

    - `tcp_pos` (3,) m and `tcp_orn` (3,) rad: the tool's pose in the world frame, with x-y-z angles
      about fixed axes.
    - `gripper_opening_width` (1,) m.
    - `robot_joints` (7,) rad.

    Action: (7,). The tool's target moves by 0.02 m per unit along the world's axes, and its angles
    change by 0.05 rad per unit. The last value is the gripper: 1 opens it, -1 closes it, and only
    the sign has an effect.

    The reward is 1 in the step that solves a task. Its sum over an episode is the number of tasks
    solved in a row, whose mean is CALVIN's average length. The episode ends when the fifth task is
    solved, or when a task exceeds its steps. `info["tasks"]` lists CALVIN's names of the tasks in
    the chain, and `info["solved"]` is the number of solved tasks.
    """

    suite, known = "calvin", SCENES
    _contract = CONTRACT
    several_tasks = True
    init_states = NUMBER
    # The name of the open environment: CALVIN's code assumes that a process has one simulation.
    _open: ClassVar[str | None] = None

    def __init__(
        self,
        task: str = "D",
        *,
        task_steps: int = STEPS,
        renderer: RendererName = "egl",
        source_dir: str | None = None,
    ) -> None:
        """Make the environment; raises the errors of `make_env`, and `ConfigError` if another
        CALVIN environment is open.

        Args:
            task: The scene, "A" to "D".
            task_steps: The limit of steps for each task of a chain.
            renderer: "egl" renders as CALVIN's evaluation does; "tiny" is PyBullet's renderer in
                software, whose light and shadows differ.
            source_dir: A checkout of CALVIN with its submodules; None selects CALVIN_SRC.
        """
        super().__init__(task, task_steps=task_steps)
        if renderer not in ("egl", "tiny"):
            raise ConfigError(f"{self._name}: renderer: expected egl or tiny, got {renderer!r}")
        if Calvin._open is not None:
            raise ConfigError(
                f"{self._name}: expected one open env in a process, got {Calvin._open} before it; "
                "close it"
            )
        self._renderer, self._checkout = renderer, find_checkout(source_dir)
        self._task_steps, self.max_steps = task_steps, TASKS * task_steps

        with self._making():
            self._env = make_simulator(self._checkout, task, renderer)
            Calvin._open = self._name
            self._resources.callback(self._free, self._env)

            omegaconf = require("omegaconf").OmegaConf
            with quietly():
                self._judge = require("hydra").utils.instantiate(
                    omegaconf.load(self._checkout / _TASKS)
                )
            texts = omegaconf.load(self._checkout / _WORDS)
            # Name of a task -> its instruction; the evaluation uses the first text of a task.
            self._words: dict[str, str] = {name: of_task[0] for name, of_task in texts.items()}
            self._chains = Chains(self._checkout)

        self._chain: Chain | None = None
        self._done = 0  # number of finished tasks
        self._task_step = 0  # steps of the current task
        # CALVIN's info about the state in which the current task began.
        self._before: dict[str, Any] = {}

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:  # noqa: ARG003 - it is the same in each scene
        return CONTRACT

    @property
    def instruction(self) -> str:
        """The current task in the words of CALVIN's evaluation."""
        return self._words[self._playing().tasks[min(self._done, TASKS - 1)]]

    @classmethod
    def not_installed(cls) -> str | None:
        cure = "run `vlagents-ray venv create calvin` and give the evaluation's workers that Python"
        return without(("pybullet", "hydra", "gym", "git", "quaternion"), cure)

    @classmethod
    def missing(cls) -> str | None:
        missing = cls.not_installed()
        if missing is not None:
            return missing
        try:
            find_checkout(None)
        except ConfigError as error:
            return str(error)
        if graphics.devices():
            return None
        return f"CALVIN finds no EGL device; {EGL_CURE}, or set the option renderer to tiny"

    def renderer(self) -> Renderer | None:
        return super().renderer() if self._renderer == "egl" else None

    def describe(self) -> dict[str, Any]:
        protocol = PROTOCOL.describe(max_steps=self.max_steps)
        if self._renderer != "egl":
            protocol["deviations"].append(f"renderer: {self._renderer}, upstream draws by OpenGL")
        code = {name: code_in(self._checkout / name) for name in (".", "calvin_env")}
        return {
            "simulator": "calvin",
            "task": self._name.partition("/")[2],
            "pybullet": version("pybullet"),
            "code": {name: state.to_json() for name, state in code.items() if state is not None},
            "renderer": self._renderer,
            "protocol": protocol,
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        env = self._env
        with quietly():
            chain = self._chains[state]
            env.load()  # Contacts of the last episode would otherwise affect the next one.
            env.robot.gripper_action = 1
            env.reset(robot_obs=chain.robot, scene_obs=chain.scene)
            self._before = env.get_info()
        self._chain, self._done, self._task_step = chain, 0, 0
        return self._observe(look=True), self._info()

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        """Execute an action; the reward is 1 if it solves a task.

        The chain ends when a task exceeds its steps.
        """
        env, chain = self._env, self._playing()
        if self._ended():
            raise NotReset(
                f"{self._name}: step after the end of the chain; call reset(seed=...) first"
            )
        command = action.astype(np.float64)
        command[-1] = 1.0 if command[-1] > 0 else -1.0

        # As in CALVIN's `step`, which would also render.
        env.robot.apply_action(command)
        for _ in range(env.action_repeat):
            env.p.stepSimulation(physicsClientId=env.cid)
        env.scene.step()

        now = env.get_info()
        current_task = chain.tasks[self._done]
        solved = bool(self._judge.get_task_info_for_set(self._before, now, {current_task}))
        self._task_step += 1
        if solved:
            self._done, self._task_step, self._before = self._done + 1, 0, now

        # The next task begins with this observation, which therefore needs images.
        obs = self._observe(look=self.looked_at or solved)
        return obs, float(solved), self._ended(), self._info()

    def _ended(self) -> bool:
        """Return whether all tasks are solved, or the current one has exceeded its steps."""
        return self._done == TASKS or self._task_step >= self._task_steps

    def _free(self, env: Any) -> None:
        """Close the simulator, and let the next environment of this process open."""
        Calvin._open, self._chain = None, None
        with quietly():
            env.close()
            # The simulator's `__del__` would otherwise close it again.
            env.ownsPhysicsClient = False

    def _observe(self, *, look: bool) -> Obs:
        """Return the current observation; without `look` it has no images."""
        env = self._alive()
        robot, _ = env.robot.get_observation()
        ends = np.cumsum([spec.dim for spec in _STATE.values()])
        values = np.split(robot[: ends[-1]].astype(np.float32), ends[:-1])

        cameras = {}
        if look:
            for camera in env.cameras:
                image, *_ = camera.render()
                cameras[camera.name] = np.ascontiguousarray(image, np.uint8)
        return Obs(
            cameras,
            gripper=1.0 if robot[-1] > 0 else 0.0,
            state=dict(zip(_STATE, values, strict=True)),
        )

    def _info(self) -> dict[str, Any]:
        return {
            "success": self._done == TASKS,
            "solved": self._done,
            "tasks": list(self._playing().tasks),
        }

    def _playing(self) -> Chain:
        """Return the chain of the current episode; raises `NotReset` if there is none."""
        if self._chain is None:
            raise NotReset(
                f"{self._name}: step was called before reset; call reset(seed=...) first"
            )
        return self._chain


def find_checkout(chosen: str | None) -> Path:
    """Return the folder of CALVIN's checkout.

    Args:
        chosen: The folder that the user named; None selects the folder in `CALVIN_SRC`.

    Returns:
        The folder, as an absolute path without symbolic links.

    Raises:
        ConfigError: No folder is named, or the folder is not a complete checkout.
    """
    folder = chosen or os.environ.get(VARIABLE)
    if not folder:
        raise ConfigError(f"calvin: {VARIABLE} is not set; {_CURE}")
    checkout = Path(folder).expanduser().resolve()
    missing = [str(path) for path in (_CONF, _TASKS, _WORDS) if not (checkout / path).exists()]
    if missing:
        raise ConfigError(
            f"calvin: expected a checkout of CALVIN with its submodules in {checkout}, got none "
            f"of {missing}; {_CURE}"
        )
    return checkout


def make_simulator(checkout: Path, scene: str, renderer: RendererName) -> Any:
    """Make CALVIN's `PlayTableSimEnv`, with the cameras, the arm and the rates of its datasets.

    Args:
        checkout: The folder of CALVIN's checkout.
        scene: "A" to "D".
        renderer: "egl", or "tiny" in software.

    Returns:
        The simulator.

    Raises:
        EnvFailed: PyBullet cannot draw through EGL.
        MissingDependency: A package is not installed.
    """
    package_folder = str(checkout / _PACKAGE)
    if package_folder not in sys.path:
        sys.path.insert(0, package_folder)
    egl_device = os.environ.get(EGL_DEVICE)
    if egl_device:
        os.environ.setdefault("EGL_VISIBLE_DEVICES", egl_device)

    with quietly():
        require("pybullet")
        hydra, omegaconf = require("hydra"), require("omegaconf").OmegaConf
        code: Any = importlib.import_module("calvin_env.envs.play_table_env")
        code.get_git_commit_hash = _no_commit_hash

        def read(name: str) -> Any:
            return omegaconf.load(checkout / _CONF / f"{name}.yaml")

        fingers = read("robot/panda_longer_finger")
        fingers.pop("defaults")  # overrides the name of the arm, which hydra would merge
        settings = omegaconf.create(
            {
                "data_path": "data",
                "use_vr": False,
                "env": read("env/play_table_env"),
                "scene": read(f"scene/calvin_scene_{scene}"),
                "robot": omegaconf.merge(read("robot/panda"), fingers),
                "cameras": {
                    "static": read("cameras/cameras/static"),
                    "gripper": read("cameras/cameras/gripper"),
                },
            }
        )
        try:
            return hydra.utils.instantiate(
                settings.env, use_scene_info=True, use_egl=renderer == "egl"
            )
        except SystemExit as error:  # PyBullet could not load its plug-in, and has printed why
            raise EnvFailed(
                f"calvin: PyBullet cannot draw through EGL; {EGL_CURE}, or set renderer to tiny"
            ) from error


def _no_commit_hash(_folder: Any) -> str:
    """Replace CALVIN's function, which needs a git repository."""
    return ""


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Suppress the output and the warnings of CALVIN's code in the block.

    An example is gym's message that it is no longer maintained. Errors are still raised.
    """
    nowhere = io.StringIO()
    with (
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield
