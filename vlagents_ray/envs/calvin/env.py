"""A scene of CALVIN as an environment for evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol
from vlagents_ray.envs.calvin import chains
from vlagents_ray.envs.calvin.simulation import Renderer, find_checkout, make_simulator, quietly, read_tasks
from vlagents_ray.envs.rendering import egl
from vlagents_ray.envs.rendering.graphics import Renderer as Device
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import EGL_CURE, failing, without
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.ray_tools.git_state import code_in

SCENES = ("A", "B", "C", "D")
TASKS, STEPS = 5, 360  # tasks of an episode, and the steps for each: evaluate_policy.py, EP_LEN
PROTOCOL = BenchmarkProtocol(
    name="CALVIN",
    source="Mees et al. 2022, arXiv 2112.03227; calvin_agent/evaluation/evaluate_policy.py at fa03f01",
    max_steps=TASKS * STEPS,
    control_hz=30.0,
    control="pose of the tool, relative: 0.02 m and 0.05 rad a unit, added to the last target",
    success="the fifth task is solved, each within 360 steps and after the one before",
    begins="one of 1000 chains of five tasks, with its initial state; the arm in one pose",
    ends_on_success=True,
    episodes=chains.NUMBER,
)
_CAMERAS = {"static": CameraSpec(200, 200), "gripper": CameraSpec(84, 84)}
_STATE = {  # parts of CALVIN's `robot_obs`, (15,), in order; its last number is the gripper's command
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
    action=ActionSpec(dim=7, space="ee_pose", delta=True, rotation="euler_xyz", gripper_open=1.0, gripper_closed=-1.0),
    control_hz=PROTOCOL.control_hz,
)


class Calvin(EvalEnv):
    """One scene of CALVIN, "A" to "D", in which an episode is a chain of five tasks.

    Observation: cameras `static`, 200x200, and `gripper`, 84x84; in `state`, in the world's frame, `tcp_pos` (3,) m and
    `tcp_orn` (3,) rad of the tool, x-y-z angles about fixed axes, `gripper_opening_width` (1,) m, and `robot_joints`
    (7,) rad; `gripper` is the last command, 1 = open.

    Action: (7,): the tool's target moves by 0.02 m a unit along the world's axes, and its angles by 0.05 rad a unit;
    the last is the gripper, 1 opens, -1 closes, and only its sign counts.

    The reward is 1 in the step that solves a task. Its sum over an episode is the number of tasks solved in a row,
    whose mean is CALVIN's average length. The episode ends with the fifth task, or with one that takes too long.
    `info["tasks"]` are CALVIN's names of the chain, `info["solved"]` says how many are solved.
    """

    several_tasks = True
    init_states = chains.NUMBER
    _open: ClassVar[str | None] = None  # upstream's code takes the process's only simulation for its own

    def __init__(
        self,
        task: str = "D",
        *,
        task_steps: int = STEPS,
        renderer: Renderer = "egl",
        source_dir: str | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: The scene.
            task_steps: The steps that each task of a chain may take.
            renderer: "egl" draws as upstream does; "tiny" is PyBullet's own in software, with other light and shadows.
            source_dir: A checkout of CALVIN with its submodules; None is that of CALVIN_SRC.

        Raises:
            UnknownEnv: There is no such scene.
            ConfigError: There is no checkout, an option has a wrong value, or this process has a CALVIN open already.
            MissingDependency: PyBullet, hydra or another package is not installed.
            EnvFailed: The simulator cannot be loaded.
        """
        self.require_task(task)
        self._env: Any = None
        self._name = f"calvin/{task}"
        if renderer not in ("egl", "tiny"):
            raise ConfigError(f"{self._name}: renderer is {renderer!r}, want egl or tiny")
        if task_steps < 1:
            raise ConfigError(f"{self._name}: task_steps is {task_steps}, want at least 1")
        if Calvin._open is not None:
            raise ConfigError(f"{self._name}: {Calvin._open} is open in this process, want one at a time; close it")
        self._renderer, self._checkout = renderer, find_checkout(source_dir)
        self._task_steps, self.max_steps = task_steps, TASKS * task_steps
        prepare_rendering()
        with failing(self._name, "make"):
            self._env = make_simulator(self._checkout, task, renderer)
            self._judge, self._words = read_tasks(self._checkout)
            self._chains = chains.Chains(self._checkout)
        Calvin._open = self._name
        self._chain: chains.Chain | None = None
        self._solved = self._steps = 0  # of this task
        self._begin: dict[str, Any] = {}  # CALVIN's information on the state in which this task began

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:  # noqa: ARG003 - it is the same in each scene
        return CONTRACT

    @property
    def contract(self) -> Contract:
        return CONTRACT

    @property
    def instruction(self) -> str:
        """The words of CALVIN's evaluation for the present task."""
        return self._words[self._playing().tasks[min(self._solved, TASKS - 1)]]

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the chain with the number `options["init_state"]`, or else `seed` modulo 1000; no more is random."""
        given = dict(options or {})
        number = given.pop("init_state", seed % chains.NUMBER)
        if given:
            raise ConfigError(f"{self._name}: unknown reset options {sorted(given)}, want init_state or none")
        if not isinstance(number, int) or not 0 <= number < chains.NUMBER:
            raise ConfigError(f"{self._name}: init_state is {number!r}, want 0 to {chains.NUMBER - 1}")
        env = self._alive()
        with failing(self._name, "reset"), quietly():
            chain = self._chains[number]
            env.load()  # or contacts of the last episode would shift the next one
            env.robot.gripper_action = 1
            env.reset(robot_obs=chain.robot, scene_obs=chain.scene)
            self._begin = env.get_info()
        self._chain, self._solved, self._steps = chain, 0, 0
        return self._observe(look=True), self._info()

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action; the reward is 1 if it solves the present task, else 0.

        A task that is not solved in time ends the chain: `terminated`, and not the step limit of the whole.
        """
        env, chain = self._alive(), self._playing()
        if self._solved == TASKS or self._steps >= self._task_steps:
            raise NotReset(f"{self._name}: step after the end of the chain; call reset(seed=...) first")
        action = one_row(act, CONTRACT).astype(np.float64)
        action[-1] = 1.0 if action[-1] > 0 else -1.0
        with failing(self._name, "step"):
            env.robot.apply_action(action)  # as upstream's `step`, which also renders
            for _ in range(env.action_repeat):
                env.p.stepSimulation(physicsClientId=env.cid)
            env.scene.step()
            now = env.get_info()
            solved = bool(self._judge.get_task_info_for_set(self._begin, now, {chain.tasks[self._solved]}))
        self._steps += 1
        if solved:
            self._solved, self._steps, self._begin = self._solved + 1, 0, now
        obs = self._observe(look=self.looked_at or solved)
        return obs, float(solved), self._solved == TASKS or self._steps >= self._task_steps, False, self._info()

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("calvin", task or "D", SCENES)

    @classmethod
    def tasks(cls) -> list[str]:
        return list(SCENES)

    @classmethod
    def missing(cls) -> str | None:
        cure = "run `vlagents-ray env make requirements/calvin.txt` and give the evaluation's workers that Python"
        if lacks := without(("pybullet", "hydra", "gym", "git", "quaternion"), cure):
            return lacks
        try:
            find_checkout(None)
        except ConfigError as error:
            return str(error)
        return None if egl.devices() else f"CALVIN finds no EGL device; {EGL_CURE}, or set the option renderer to tiny"

    def renderer(self) -> Device | None:
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

    def close(self) -> None:
        env, self._env, self._chain = self._env, None, None
        if env is not None:
            Calvin._open = None
            with quietly():
                env.close()
                env.ownsPhysicsClient = False  # it would be closed again by `__del__`

    def _observe(self, *, look: bool) -> Obs:
        env = self._alive()
        robot, _ = env.robot.get_observation()
        parts = np.split(robot[:14].astype(np.float32), np.cumsum([spec.dim for spec in _STATE.values()])[:-1])
        cameras = {}
        if look:
            cameras = {one.name: np.ascontiguousarray(one.render()[0], np.uint8) for one in env.cameras}
        return Obs(cameras, 1.0 if robot[14] > 0 else 0.0, dict(zip(_STATE, parts, strict=True)))

    def _info(self) -> dict[str, Any]:
        return {"success": self._solved == TASKS, "solved": self._solved, "tasks": list(self._playing().tasks)}

    def _playing(self) -> chains.Chain:
        if self._chain is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        return self._chain

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env
