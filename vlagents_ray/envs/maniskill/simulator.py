"""The simulator of ManiSkill's tasks, and their instructions.

Environments are made in processes without a terminal.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import io
import logging
import math
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import require_cameras
from vlagents_ray.envs.graphics import Renderer, prepare_rendering, vulkan_device, vulkan_renderer
from vlagents_ray.envs.simulator import failing, require_sizes
from vlagents_ray.errors import ConfigError, EnvFailed, UnknownEnv
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require

DEFAULT_CONTROL_MODE = "pd_ee_delta_pose"

# Instructions of the tasks whose assets are in ManiSkill's package.
INSTRUCTIONS: dict[str, str] = {
    "LiftPegUpright-v1": "lift the peg and stand it upright on the table",
    "PegInsertionSide-v1": "pick up the peg and insert its orange end into the hole in the box",
    "PickCube-v1": "pick up the red cube and move it to the goal",
    "PlugCharger-v1": "pick up the charger and plug it into the receptacle",
    "PokeCube-v1": "poke the cube with the peg and push it onto the red and white target",
    "PullCube-v1": "pull the cube onto the red and white target",
    "PullCubeTool-v1": "pick up the L-shaped tool and pull the cube towards the robot with it",
    "PushCube-v1": "push the cube onto the red and white target",
    "PushT-v1": "push the T-shaped block onto the T-shaped target",
    "RollBall-v1": "roll the ball onto the red and white target",
    "StackCube-v1": "pick up the red cube and stack it on the green cube",
}


def instruction_for(task: str) -> str:
    """Return the instruction of a task, or its name in words.

    The words for "PickSingleYCB-v1" are "pick single ycb".
    """
    if task in INSTRUCTIONS:
        return INSTRUCTIONS[task]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", re.sub(r"-v\d+$", "", task))
    return " ".join(words).lower()


def step_limits(env: str, task: str, max_steps: int | None) -> tuple[int, int | None]:
    """Return the step limits of a task, and prepare the process for ManiSkill.

    Args:
        env: The env's name, for errors.
        task: ManiSkill's id.
        max_steps: The limit to use; None selects the limit of the task.

    Returns:
        The limit to use, and the limit of the task, if it has one.

    Raises:
        UnknownEnv: The task is unknown.
        ConfigError: There is no limit, or the limit is below 1.
    """
    prepare_rendering()
    require("sapien")
    require("mani_skill.envs")
    _prepare_process()
    registered = require("mani_skill.utils.registration").REGISTERED_ENVS
    if task not in registered:
        raise UnknownEnv(
            f"maniskill: expected a task of {sorted(INSTRUCTIONS)}, or another of ManiSkill's "
            f"ids, got {task!r}"
        )

    task_limit: int | None = registered[task].max_episode_steps
    limit = task_limit if max_steps is None else max_steps
    if limit is None:
        raise ConfigError(f"{env} has no step limit; set max_steps")
    require_sizes(env, max_steps=limit)
    return limit, task_limit


def chosen_backend(render_backend: str) -> str:
    """Resolve the render backend "auto"; other values are returned unchanged.

    "auto" selects the GPU if SAPIEN can render on it and torch can synchronize with it. Otherwise
    it selects the CPU.
    """
    if render_backend != "auto":
        return render_backend
    try:
        require("sapien").Device("cuda")
    except RuntimeError:  # SAPIEN raises this if there is no device
        return "cpu"
    return "gpu" if require("torch").cuda.is_available() else "cpu"


def make_bare(
    task: str, control_mode: str | None, *, sim_backend: str, render_backend: str, **options: Any
) -> Any:
    """Create the bare environment, without Gymnasium's wrappers.

    Args:
        task: ManiSkill's id.
        control_mode: None selects `DEFAULT_CONTROL_MODE`, or the robot's default if the robot lacks
            that mode.
        sim_backend: ManiSkill's name.
        render_backend: ManiSkill's name.
        options: Further arguments of `gymnasium.make`; None selects ManiSkill's default.

    Raises:
        ConfigError: The robot lacks the control mode.
        EnvFailed: The environment cannot be created for another reason.
    """
    arguments = {name: value for name, value in options.items() if value is not None}
    arguments |= {"sim_backend": sim_backend, "render_backend": render_backend}
    gymnasium = require("gymnasium")
    with _no_prompts(task), failing(f"maniskill/{task}", "make"), warnings.catch_warnings():
        # Creating the digital twin of the cubes causes this warning, for a list of 24 arrays.
        warnings.filterwarnings("ignore", "Creating a tensor from a list of numpy", UserWarning)
        _keep_renderer(sim_backend, render_backend)

        mode = control_mode or DEFAULT_CONTROL_MODE
        try:
            return gymnasium.make(task, control_mode=mode, **arguments).unwrapped
        except AssertionError as error:
            if "not in supported modes" not in str(error):
                raise
            if control_mode is not None:
                raise ConfigError(f"maniskill/{task}: control_mode {error}") from error
        return gymnasium.make(task, **arguments).unwrapped


@contextlib.contextmanager
def _no_prompts(task: str) -> Iterator[None]:
    """Convert ManiSkill's prompts within the context to `EnvFailed`.

    If assets are missing, ManiSkill prompts on stdin for their download.
    """
    output = io.StringIO()
    stdin, sys.stdin = sys.stdin, io.StringIO("n\n")
    try:
        with contextlib.redirect_stdout(output):
            yield
    except SystemExit as error:
        lines = [line for line in output.getvalue().splitlines() if "found" in line]
        prompt = lines[0] if lines else "ManiSkill does not name them"
        robot = re.match(r"Robot (\S+) ", prompt)
        raise EnvFailed(
            f"maniskill/{task}: assets are missing ({prompt.partition(' Would you')[0]}); download "
            f"them with: python -m mani_skill.utils.download_asset {robot[1] if robot else task}"
        ) from error
    finally:
        sys.stdin = stdin
        sys.stdout.write(output.getvalue())


@functools.cache
def _prepare_process() -> None:
    """Make reconfigurations fast, and suppress repeated warnings; done once per process."""
    # ManiSkill collects garbage at each reconfiguration, which takes 150 ms. Most of this time is
    # spent on imported modules, which are not garbage, so exclude them.
    gc.collect()
    gc.freeze()
    # Tasks and robots repeat these warnings at each reconfiguration, and users cannot avoid them.
    # The logger's name ends with a space.
    repeated = ("No initial pose set for ", "Mimic targets dictionary is missing")
    logging.getLogger("mani_skill ").addFilter(
        lambda record: not record.getMessage().startswith(repeated)
    )


@functools.cache
def _keep_renderer(sim_backend: str, render_backend: str) -> object:
    """Keep a renderer for the lifetime of the process.

    Otherwise SAPIEN frees its device and its compiled shaders with the last scene that uses them,
    and creating the next environment takes 5 s instead of 0.1 s.
    """
    import sapien.render

    parse = require("mani_skill.envs.utils.system.backend").parse_sim_and_render_backend
    device = parse(sim_backend, render_backend).render_device
    return None if device is None else sapien.render.RenderSystem(device)


# ManiSkill's name of a robot -> position of a finger's joint when closed and when open, m. In an
# action for these robots, the last value is the gripper: -1 is closed, 1 is open. Other robots have
# no gripper in the contract.
_FINGER_M = {
    "panda": (0.0, 0.04),
    "panda_wristcam": (0.0, 0.04),
    "widowx250s_bridgedataset_flat_table": (0.015, 0.037),
    "widowx250s_bridgedataset_sink": (0.015, 0.037),
}
# Robot -> the link whose pose is the tool's pose, if ManiSkill names no tool centre point.
_TOOL_LINK = "ee_gripper_link"

# Control mode -> description of the action's values that move the arm, from
# mani_skill/agents/controllers. The rotation of "pd_ee_*pose" is intrinsic XYZ Euler in the base
# frame; see `ManiSkill` for its sign.
_EE_POSE = {"space": "ee_pose", "rotation": "euler_xyz", "frame": "base"}
_EE_POSITION = {"space": "ee_position", "rotation": "none", "frame": "base"}
_JOINT: dict[str, Any] = {"space": "joint", "rotation": "none"}
CONTROL_MODES: dict[str, dict[str, Any]] = {
    "pd_ee_delta_pose": {**_EE_POSE, "delta": True},
    "pd_ee_target_delta_pose": {**_EE_POSE, "delta": True},
    "pd_ee_pose": {**_EE_POSE, "delta": False},
    "pd_ee_delta_pos": {**_EE_POSITION, "delta": True},
    "pd_ee_target_delta_pos": {**_EE_POSITION, "delta": True},
    "pd_joint_pos": {**_JOINT, "delta": False},
    "pd_joint_delta_pos": {**_JOINT, "delta": True},
    "pd_joint_target_delta_pos": {**_JOINT, "delta": True},
    "pd_joint_vel": {"space": "joint_velocity", "rotation": "none"},
}


class ManiSkillRobot:
    """Reads the proprioception from ManiSkill's `agent`, which each reconfiguration replaces."""

    def __init__(self, agent: Any) -> None:
        """Read the names of the joints of an `agent` of ManiSkill."""
        names = [joint.name for joint in agent.robot.active_joints]
        arm_joints = getattr(agent, "arm_joint_names", names)
        finger_joints = getattr(agent, "gripper_joint_names", ())
        self._arm = np.array([names.index(name) for name in arm_joints])
        self._fingers = np.array([names.index(name) for name in finger_joints], dtype=int)
        self._finger_m = _FINGER_M.get(agent.uid)
        self.has_gripper = self._finger_m is not None

        self.state = {"joints": StateSpec(len(self._arm), "rad")}
        if _tool(agent) is not None:
            self.state |= {"tquat": StateSpec(7, "m+quat_xyzw"), "xyzrpy": StateSpec(6, "m+rad")}

    def read(self, agent: Any) -> list[tuple[dict[str, np.ndarray], float | None]]:
        """Read the proprioception of all environments.

        Args:
            agent: The current `agent`.

        Returns:
            For each environment, the state, whose values are (D,) float32, and the gripper in [0,
            1], 1 = open, or None if there is no gripper.
        """
        rows = agent.robot.get_qpos().cpu().numpy()
        states = [{"joints": qpos[self._arm]} for qpos in rows]
        if "tquat" in self.state:
            bases = agent.robot.pose.raw_pose.cpu().numpy()
            tools = _tool(agent).pose.raw_pose.cpu().numpy()
            for state, base, tool in zip(states, bases, tools, strict=True):
                state["tquat"], state["xyzrpy"] = tool_in_base(base, tool)

        return [(state, self._opening(qpos)) for state, qpos in zip(states, rows, strict=True)]

    def _opening(self, qpos: np.ndarray) -> float | None:
        """Return the gripper's opening in [0, 1] for joint positions (D,)."""
        if self._finger_m is None:
            return None

        closed_m, open_m = self._finger_m
        position_m = float(qpos[self._fingers].mean())
        return min(max((position_m - closed_m) / (open_m - closed_m), 0.0), 1.0)


def _tool(agent: Any) -> Any:
    """Return the link whose pose is the tool's pose; None if there is no such link."""
    tcp = getattr(agent, "tcp", None)
    return agent.robot.links_map.get(_TOOL_LINK) if tcp is None else tcp


def action_spec(control_mode: str, space: Any, *, has_gripper: bool) -> ActionSpec:
    """Return the description of actions for the contract.

    Args:
        control_mode: ManiSkill's name; the meaning of actions is known for `CONTROL_MODES`.
        space: The space of actions, Box (D,).
        has_gripper: Whether the last value of an action is a gripper.
    """
    normalized = bool((space.low == -1.0).all() and (space.high == 1.0).all())
    return ActionSpec(
        dim=int(space.shape[0]),
        gripper_open=1.0 if has_gripper else None,
        gripper_closed=-1.0 if has_gripper else None,
        low=-1.0 if normalized else None,
        high=1.0 if normalized else None,
        **CONTROL_MODES.get(control_mode, {}),
    )


_LOCKED = 1e-4  # cosine of the pitch below which roll and yaw are not separately determined


def tool_in_base(base: np.ndarray, tool: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the tool's pose in the base frame.

    Args:
        base: Pose of the base in the world frame, (7,), m and quaternion wxyz, as in SAPIEN.
        tool: Pose of the tool in the world frame, (7,).

    Returns:
        `tquat` (7,), m and quaternion xyzw with w >= 0, and `xyzrpy` (6,), m and rad, where
        R = Rz(yaw) Ry(pitch) Rx(roll); both float32.
    """
    bw, bx, by, bz = base[3:].astype(float).tolist()
    tw, tx, ty, tz = tool[3:].astype(float).tolist()

    # The rotation is conj(base) * tool.
    w = bw * tw + bx * tx + by * ty + bz * tz
    x = bw * tx - bx * tw - by * tz + bz * ty
    y = bw * ty + bx * tz - by * tw - bz * tx
    z = bw * tz - bx * ty + by * tx - bz * tw
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z

    # The offset p, rotated by conj(base), is p + 2 b x (b x p - bw p), where b = (bx, by, bz).
    px, py, pz = (tool[:3] - base[:3]).astype(float).tolist()
    cx = by * pz - bz * py - bw * px
    cy = bz * px - bx * pz - bw * py
    cz = bx * py - by * px - bw * pz
    px += 2 * (by * cz - bz * cy)
    py += 2 * (bz * cx - bx * cz)
    pz += 2 * (bx * cy - by * cx)

    # Sine and cosine of the roll, each multiplied by the cosine of the pitch.
    roll_sine, roll_cosine = 2 * (w * x + y * z), 1 - 2 * (x * x + y * y)
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    if math.hypot(roll_sine, roll_cosine) < _LOCKED:
        # Gimbal lock: only the sum or the difference of roll and yaw is determined.
        roll, yaw = 0.0, math.copysign(2.0, -pitch) * math.atan2(x, w)
        yaw = math.remainder(yaw, 2 * math.pi)
    else:
        roll = math.atan2(roll_sine, roll_cosine)
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    tquat = np.array([px, py, pz, x, y, z, w], dtype=np.float32)
    return tquat, np.array([px, py, pz, roll, pitch, yaw], dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Moment:
    """The result of a reset or step, with a row for each environment."""

    obs: list[Obs]
    success: list[bool]
    rewards: list[float]


class Simulator:
    """The environments of one ManiSkill task; they continue after success."""

    def __init__(
        self,
        name: str,
        task: str,
        *,
        obs_mode: str,
        num_envs: int = 1,
        cameras: Sequence[str] | None = None,
        sim_backend: str,
        render_backend: str = "auto",
        control_mode: str | None = None,
        reward_mode: str | None = None,
        sensors: Mapping[str, Any],
    ) -> None:
        """Create the simulator.

        Args:
            name: The env's name, for errors.
            task: ManiSkill's id.
            obs_mode: ManiSkill's name.
            num_envs: The number of environments.
            cameras: The cameras of the task to render; None selects all cameras.
            sim_backend: ManiSkill's name.
            render_backend: "cpu", "gpu", or "auto".
            control_mode: As in `make_bare`.
            reward_mode: ManiSkill's name; None selects the task's mode.
            sensors: ManiSkill's options of the cameras.

        Raises:
            ConfigError: The task has no success or not exactly one robot, or a name is unknown.
            EnvFailed: The simulator cannot be created; the message contains the cure.
        """
        self.name, self._task = name, task
        self._asked_for = render_backend != "auto"
        self.env: Any = make_bare(
            task,
            control_mode,
            num_envs=num_envs,
            obs_mode=obs_mode,
            reward_mode=reward_mode,
            sim_backend=sim_backend,
            render_backend=chosen_backend(render_backend),
            sensor_configs=dict(sensors),
        )
        try:
            if not hasattr(self.env.agent, "robot"):  # The task has no robot or several robots.
                raise ConfigError(
                    f"{self.name}: expected a task with exactly one robot; choose another task"
                )
            if "success" not in self.env.get_info():
                raise ConfigError(
                    f"{self.name}: expected a task that reports success, got a task without "
                    f"success; choose another task"
                )

            sizes = {}
            sensor_spaces = self.env.single_observation_space["sensor_data"]
            for camera, textures in sensor_spaces.items():
                if "rgb" in textures.spaces:
                    sizes[camera] = textures["rgb"].shape[:2]
            require_cameras(self.name, cameras or (), sizes)
            self.cameras = {}
            for camera in sizes if cameras is None else cameras:
                height, width = sizes[camera]
                self.cameras[camera] = CameraSpec(height=height, width=width)

            self._robot = ManiSkillRobot(self.env.agent)
        except BaseException:
            self.close()
            raise

    def contract(self, action: ActionSpec | None = None) -> Contract:
        """Return the contract.

        Args:
            action: The description of actions; None selects the description for the control mode.
        """
        env, has_gripper = self.alive(), self._robot.has_gripper
        if action is None:
            action = action_spec(env.control_mode, env.single_action_space, has_gripper=has_gripper)
        return Contract(
            cameras=self.cameras,
            state=self._robot.state,
            gripper=has_gripper,
            instruction=True,
            action=action,
            control_hz=float(env.control_freq),
        )

    def instructions(self) -> list[str]:
        """Return the instruction of each environment: ManiSkill's instruction, or else this
        package's instruction for the task.
        """
        env = self.alive()
        get_instructions = getattr(env, "get_language_instruction", None)
        if get_instructions is None:
            return [instruction_for(self._task)] * env.num_envs
        return [str(text) for text in get_instructions()]

    def reset(self, seeds: Sequence[int], options: Mapping[str, Any]) -> Moment:
        """Begin an episode in each environment; seeds are taken modulo 2^32."""
        env = self.alive()
        with failing(self.name, "reset"):
            raw, info = env.reset(seed=[seed % 2**32 for seed in seeds], options=dict(options))
            # Rendering dominates the time of a step, so only the requested cameras are rendered.
            if env.num_envs == 1:
                for name in set(env.scene.sensors) - set(self.cameras):
                    del env.scene.sensors[name]
            return self.moment(raw, info)

    def reset_each(self, seeds: Sequence[int], options: Sequence[Mapping[str, Any]]) -> Moment:
        """Begin the episode of each environment separately, in the existing scenes.

        ManiSkill seeds torch once for all environments that it resets together, with the seed of
        the first environment. The random draws that a task makes with torch would then depend on
        the other environments.
        """
        env = self.alive()
        with failing(self.name, "reset"):
            with self._observing("none"):  # Do not render before all episodes have begun.
                for i, (seed, env_options) in enumerate(zip(seeds, options, strict=True)):
                    index = require("torch").tensor([i], device=env.device)
                    env.reset(
                        seed=[seed % 2**32] * env.num_envs,
                        options={**env_options, "env_idx": index},
                    )
            info = env.get_info()
            return self.moment(env.get_obs(info), info)

    def step(self, actions: np.ndarray, *, look: bool = True) -> Moment:
        """Execute an action in each environment.

        Args:
            actions: (N, D) float32.
            look: Whether to render images.

        Returns:
            The observations, the successes and the rewards after the step.
        """
        env = self.alive()
        observing = contextlib.nullcontext() if look else self._observing("state_dict")
        with failing(self.name, "step"), observing:
            # Copy the actions, since torch shares their memory, and warns about read-only arrays
            # like Ray's.
            raw, rewards, _, _, info = env.step(actions.copy())
            moment = self.moment(raw, info)
            return replace(moment, rewards=rewards.cpu().numpy().astype(float).tolist())

    def moment(self, raw: Mapping[str, Any], info: Mapping[str, Any]) -> Moment:
        """Convert ManiSkill's observation and info.

        The images of a camera are rows of one array, (N, H, W, 3) uint8.
        """
        env = self.alive()
        images = {}
        rendered = raw.get("sensor_data")
        if rendered is not None:
            for name in self.cameras:
                images[name] = np.ascontiguousarray(rendered[name]["rgb"].cpu().numpy())
        sim_states = raw["state"].cpu().numpy() if "state" in raw else None

        observations = []
        for i, (state, gripper) in enumerate(self._robot.read(env.agent)):
            env_images = {name: rows[i] for name, rows in images.items()}
            obs_info = {} if sim_states is None else {"sim_state": sim_states[i]}
            observations.append(Obs(env_images, gripper, state, obs_info))
        success = [bool(value) for value in info["success"]]
        return Moment(observations, success, [0.0] * len(observations))

    def renderer(self) -> Renderer | None:
        """Return the device on which SAPIEN renders; None if it does not render."""
        device = vulkan_device(on_gpu=self.alive().backend.render_device.is_cuda())
        if device is None:
            return None
        name, cuda = device
        return vulkan_renderer(name, cuda, asked_for=self._asked_for)

    def describe(self) -> dict[str, Any]:
        """Return the versions, the robot, the modes and backends, and the shaders."""
        env = self.alive()
        renderer = self.renderer()
        shaders = {}
        for name in self.cameras:
            shaders[name] = env.scene.sensors[name].config.shader_config.shader_pack
        return {
            "simulator": "maniskill",
            "task": self._task,
            "mani_skill": version("mani-skill"),
            "sapien": version("sapien"),
            "robot": env.agent.uid,
            "control_mode": env.control_mode,
            "obs_mode": env.obs_mode,
            "reward_mode": env.reward_mode,
            "sim_backend": env.backend.sim_backend,
            "render_backend": env.backend.render_backend,
            "render_device": None if renderer is None else renderer.name,
            "shaders": shaders,
            "num_envs": env.num_envs,
        }

    def alive(self) -> Any:
        """Return ManiSkill's environment; raises `EnvFailed` after `close`."""
        if self.env is None:
            raise EnvFailed(f"{self.name} is closed; create a new environment")
        return self.env

    def close(self) -> None:
        """Free the simulator; safe to call twice."""
        env, self.env = self.env, None
        if env is not None:
            env.close()

    @contextlib.contextmanager
    def _observing(self, mode: str) -> Iterator[None]:
        """Switch the observation mode within the context.

        Tasks still choose their additions to the state by the original mode.
        """
        env = self.alive()
        original_mode, env._obs_mode = env._obs_mode, mode
        try:
            yield
        finally:
            env._obs_mode = original_mode
