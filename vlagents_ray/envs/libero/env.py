"""A LIBERO task as an environment for evaluations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.libero.package import assets_digest, find_assets
from vlagents_ray.envs.libero.tasks import (
    LiberoProtocol,
    LiberoTask,
    find_task,
    read_states,
    require_suite,
    task_names,
)
from vlagents_ray.envs.robosuite import CameraRenderer, gripper_opening, seeded
from vlagents_ray.envs.simulator import SimulatorEnv
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require


class Libero(SimulatorEnv):
    """One environment of one LIBERO task, e.g. "libero_spatial/0".

    Observation: cameras "front" (LIBERO's agentview) and "wrist" (its eye in hand), turned as policies
    expect it, see `LiberoProtocol`; in `state` what policies for LIBERO take: `xyz_axis_angle` (6,), the end
    effector in the world's frame, whose axes are the robot base's, m and rad, the angle in [0, 2 pi] as
    robosuite's quaternion gives it; `gripper_qpos` (2,) m, of the fingers; and `joints` (7,) rad. In
    `info["sim_state"]`, for scripted experts only: `positions` of objects (3,) m in the world's frame, and
    the `goal`.

    Action: (7,) in [-1, 1]: the end effector's target moves by 0.05 m a unit along the base's axes, and
    turns by 0.5 rad a unit about them, axis-angle; the last is the gripper, -1 opens, 1 closes, and only
    its sign counts.

    An episode is a pure function of its initial state, `options["init_state"]`; where that is not given,
    the seed chooses it, and otherwise the seed is the policy's alone.
    """

    suite, title = "libero", "LIBERO"
    packages, distributions = ("libero", "robosuite", "mujoco"), ("hf-libero", "robosuite", "mujoco")
    cure = "pip install 'vlagents-ray[libero]'"

    def __init__(
        self,
        task: str = "libero_spatial/0",
        *,
        width: int = 256,
        height: int = 256,
        max_steps: int | None = None,
        settling_steps: int | None = None,
        simulator_seed: int | None = None,
        stop_at_success: bool = True,
        gripper_open: float | None = None,
        gripper_closed: float | None = None,
        instruction: str | None = None,
        assets: str | None = None,
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are those of most `SimulatorEnv`s.

        Args:
            task: "SUITE/NUMBER", or "SUITE/NAME" with LIBERO's name.
            settling_steps: None is the protocol's.
            simulator_seed: Seed of whatever an initial state leaves open; None is the protocol's.
            stop_at_success: Report `terminated` when the task is solved.
            gripper_open: The action's last number that opens the gripper; None is LIBERO's -1. OpenVLA
                says 1, and 0 to close, which openvla's evaluation turns into LIBERO's as this does.
            gripper_closed: The one that closes it; None is LIBERO's 1.
            assets: The folder with LIBERO's meshes and textures; None is what LIBERO_ASSETS names.
        """
        super().__init__(f"libero/{task}", width=width, height=height, max_steps=max_steps)
        if (settling_steps or 0) < 0:
            raise ConfigError(f"libero/{task}: settling_steps is {settling_steps}, want 0 or more")
        self._task = find_task(task)
        self._name = f"libero/{self._task.full_name}"
        self._assets = find_assets(assets)
        self._rules = LiberoProtocol.of(
            self._task.suite,
            image_size=(height, width),
            max_steps=max_steps,
            settling_steps=settling_steps,
            simulator_seed=simulator_seed,
            stop_at_success=stop_at_success,
            gripper_open=gripper_open,
            gripper_closed=gripper_closed,
        )
        if self._rules.gripper_open == self._rules.gripper_closed:
            raise ConfigError(f"libero/{task}: the gripper opens and closes at {gripper_open}; want two numbers")
        self.max_steps, self._ends_on_success = self._rules.max_steps, stop_at_success
        self._instruction = instruction or self._task.language
        self._contract = _contract_of(self._rules)
        with self._making():
            self._states = read_states(self._task.states)
            self._env = LiberoSimulation(self._task, self._rules, self._assets)
            self._resources.callback(self._env.close)
        self.init_states = len(self._states)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        size = (arguments["height"], arguments["width"])
        grippers = {name: arguments[name] for name in ("gripper_open", "gripper_closed")}
        return _contract_of(LiberoProtocol.of(arguments["task"].partition("/")[0], image_size=size, **grippers))

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_suite(task or "")

    @classmethod
    def tasks(cls) -> list[str]:
        return task_names()

    @classmethod
    def _missing_assets(cls) -> str | None:
        try:
            find_assets()
        except EnvFailed as error:
            return str(error)
        return None

    def describe(self) -> dict[str, Any]:
        return super().describe() | {
            "name": self._task.name,
            "language": self._task.language,
            "init_states": self.init_states,
            "protocol": self._rules.to_json(self._task.suite),
            "assets": assets_digest(self._assets),
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        seen = self._env.begin(self._states[state])
        return self._observe(seen), {"success": seen.success}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        seen = self._env.step(to_simulator(action, self._rules), look=self.looked_at)
        return self._observe(seen, look=self.looked_at), float(seen.success), *self._solved(seen.success)

    def _observe(self, seen: SimulatorObs, *, look: bool = True) -> Obs:
        cameras = self._rules.cameras if look else {}
        raw = seen.raw
        state = {
            "xyz_axis_angle": np.concatenate([raw["robot0_eef_pos"], axis_angle(raw["robot0_eef_quat"])]),
            "gripper_qpos": raw["robot0_gripper_qpos"],
            "joints": raw["robot0_joint_pos"],
        }
        return Obs(
            cameras={name: _turned(raw[f"{own}_image"]) for name, own in cameras.items()},
            gripper=gripper_opening(raw),
            state={name: part.astype(np.float32) for name, part in state.items()},
            info={"sim_state": {"positions": self._env.positions(), "goal": self._env.goal}},
        )


def _turned(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1, ::-1])


def _contract_of(protocol: LiberoProtocol) -> Contract:
    return Contract(
        cameras={name: CameraSpec(*protocol.image_size) for name in protocol.cameras},
        state={
            "xyz_axis_angle": StateSpec(6, "m+rad"),
            "gripper_qpos": StateSpec(2, "m"),
            "joints": StateSpec(7, "rad"),
        },
        gripper=True,
        instruction=True,
        action=ActionSpec(
            dim=7,
            space="ee_pose",
            delta=True,
            rotation="axis_angle",
            frame="base",
            gripper_open=protocol.gripper_open,
            gripper_closed=protocol.gripper_closed,
            low=-1.0,
            high=1.0,
        ),
        control_hz=protocol.control_hz,
    )


def to_simulator(action: np.ndarray, protocol: LiberoProtocol) -> np.ndarray:
    """An action under `protocol`, (7,), as robosuite takes it: the gripper -1 to open, 1 to close, 0 to stay.

    Closer to `gripper_open` means open, as in openvla's evaluation, which binarises, and as robosuite's own
    gripper does, of whose command only the sign counts.
    """
    middle = (protocol.gripper_open + protocol.gripper_closed) / 2
    command = np.sign((action[6] - middle) * (protocol.gripper_closed - protocol.gripper_open))
    return np.append(action[:6], command).astype(np.float64)


def axis_angle(quaternion: np.ndarray) -> np.ndarray:
    """A unit quaternion xyzw to axis times angle, (3,) rad, the angle in [0, 2 pi].

    As robosuite's `quat2axisangle`, q and -q give different ones: policies were trained on states in which
    no sign was normalised. For a gripper that points down w is near 0, and a state that chose the sign by it
    would jump.
    """
    w = min(max(float(quaternion[3]), -1.0), 1.0)
    sine = math.sqrt(1.0 - w * w)
    if math.isclose(sine, 0.0):
        return np.zeros(3)
    turned: np.ndarray = np.asarray(quaternion[:3], np.float64) * 2.0 * math.acos(w) / sine
    return turned


_ATTEMPTS = 1000  # to place the scene's objects; one is enough nearly always


@dataclass(frozen=True, slots=True)
class SimulatorObs:
    """The simulator's observation after a step."""

    raw: Mapping[str, Any]  # robosuite's observation
    success: bool


class LiberoSimulation:
    """Steps the simulator by the protocol, and renders only images that are used."""

    def __init__(self, task: LiberoTask, protocol: LiberoProtocol, assets: Path) -> None:
        self._package: Any = require("libero.libero")
        self._assets = assets
        self._protocol = protocol
        self._use_assets()
        self._env: Any = require("libero.libero.envs").OffScreenRenderEnv(
            bddl_file_name=str(task.problem),
            controller=protocol.controller,
            control_freq=protocol.control_hz,
            camera_names=list(protocol.cameras.values()),
            camera_heights=protocol.image_size[0],
            camera_widths=protocol.image_size[1],
            horizon=protocol.settling_steps + protocol.max_steps + 1,  # robosuite's own limit stays out of the way
        )
        self._cameras = CameraRenderer(self._env.env)

    def begin(self, state: np.ndarray) -> SimulatorObs:
        """Seed, reset, set the initial `state`, (D,) float64, and let the objects settle."""
        settling = self._protocol.settling_steps
        self._use_assets()
        self._cameras.make_current()  # the last episode's rendering resources are freed in their own context
        self._cameras.open = False
        with seeded(self._protocol.simulator_seed):
            self._reset()
            self._cameras.open = settling == 0
            raw = self._env.set_init_state(state)
            success = bool(self._env.check_success())
            for i in range(settling):
                self._cameras.open = i == settling - 1
                raw, _, success, _ = self._env.step(list(self._protocol.settling_action))
        self._cameras.open = True
        return SimulatorObs(raw, bool(success))

    def step(self, action: np.ndarray, *, look: bool = True) -> SimulatorObs:
        """Execute an action, (7,) float64, clipped to [-1, 1] by the controller; without `look` nothing is rendered."""
        self._cameras.open = look
        raw, _, success, _ = self._env.step(action)
        return SimulatorObs(raw, bool(success))

    @property
    def goal(self) -> list[list[str]]:
        """The goal's predicates, all of which must hold, e.g. [["on", "akita_black_bowl_1", "plate_1"]]."""
        return [[str(word) for word in predicate] for predicate in self._env.env.parsed_problem["goal_state"]]

    def positions(self) -> dict[str, np.ndarray]:
        """Return the positions of all objects and other parts of the goal, (3,) float64, m in the world's frame."""
        domain = self._env.env
        states = domain.object_states_dict
        named = {*domain.objects_dict, *(name for _, *names in self.goal for name in names)}
        return {
            name: np.array(states[name].get_geom_state()["pos"], np.float64) for name in sorted(named & set(states))
        }

    def flat_state(self) -> np.ndarray:
        """MuJoCo's time, qpos and qvel, (D,) float64, as the initial states are written."""
        state: np.ndarray = self._env.get_sim_state()
        return state

    def close(self) -> None:
        self._cameras.make_current()
        self._env.close()

    def _reset(self) -> None:
        """Do the work of `OffScreenRenderEnv.reset`, which itself repeats it after any error, without end."""
        crowded = require("robosuite.utils.errors").RandomizationError
        for _ in range(_ATTEMPTS):
            try:
                self._env.env.reset()
            except crowded:  # the drawn places overlap: draw again
                continue
            return
        raise EnvFailed(f"the scene's objects found no place in {_ATTEMPTS} draws")

    def _use_assets(self) -> None:
        self._package._assets_path_cache = str(self._assets)  # global in the process: another env may have set it
