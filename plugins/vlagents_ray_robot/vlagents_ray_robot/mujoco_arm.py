"""Arms in MuJoCo as robots: SO-101, Franka, ALOHA, UR5e, xArm7, and any other MJCF or URDF file;
extra "arms".
"""

from __future__ import annotations

import os
import re
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require
from vlagents_ray_robot import DISTRIBUTION
from vlagents_ray_robot.check import Operator, arm_part

# Set this before any import of mujoco, which reads it; packages of models import mujoco.
if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")
_SETTLING_S = 1.0  # the time in which an arm comes to rest at the beginning
_GRIPPER = re.compile(r"gripper|finger|knuckle|jaw|fingers_actuator")
# The prefix of the names that are added to a model, so that they differ from the model's names.
_PREFIX = "vlagents_ray/"
# Gains of the controller for a model that has none, N m/rad and N m s/rad.
_KP, _KV = 1000.0, 100.0
_RED = (220, 20, 30)  # the colour of the card of `SimulatedOperator`, RGB


@dataclass(frozen=True)
class ArmModel:
    """The properties of an arm that its model file does not contain."""

    menagerie: str  # the folder of the model in the MuJoCo Menagerie
    # The rest pose of the joints without the gripper, rad; if empty, the file's first keyframe.
    rest: tuple[float, ...] = ()
    open_high: bool = True  # whether the gripper opens towards the upper end of its range
    arms: tuple[str, ...] = ()  # the names of several arms, in the order of the file


ARMS = {
    "so101": ArmModel("robotstudio_so101", rest=(0.2, -0.6, 0.5, 0.8, 0.1)),
    "franka": ArmModel("franka_emika_panda", rest=(0.0, -0.3, 0.0, -1.9, 0.0, 1.6, 0.8)),
    "aloha": ArmModel("aloha", rest=2 * (0.0, -0.96, 1.16, 0.0, -0.3, 0.0), arms=("left", "right")),
    "ur5e": ArmModel("universal_robots_ur5e"),
    "xarm7": ArmModel(
        "ufactory_xarm7", rest=(0.0, -0.25, 0.0, 0.9, 0.0, 1.1, 0.0), open_high=False
    ),
}


class SimulatedClock:
    """The functions of the module `time` that robots and their check use, in simulated time."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._began_s = time.time()

    def monotonic(self) -> float:
        """Return the simulated time since the start, s."""
        return self._now_s

    def time(self) -> float:
        """Return the simulated time since 1970, s."""
        return self._began_s + self._now_s

    def sleep(self, seconds: float) -> None:
        """Let simulated time pass."""
        self._now_s += seconds


@dataclass(slots=True)
class _Drive:
    """The actuators that one number of an action moves: those of a joint, or of a gripper's
    fingers.
    """

    name: str
    actuators: list[int] = field(default_factory=list)
    # For each actuator: the lower limit of a joint, or the control value of a closed gripper.
    low: list[float] = field(default_factory=list)
    # For each actuator: the upper limit of a joint, or the control value of an open gripper.
    high: list[float] = field(default_factory=list)
    gripper: bool = False

    @property
    def limits(self) -> tuple[float, float]:
        """The lowest and the highest number of an action."""
        return (0.0, 1.0) if self.gripper else (self.low[0], self.high[0])


class MujocoArm:
    """A simulated arm with a position controller, cameras, latency and measured joints.

    For each arm, an action contains the target of each joint, rad, followed by the gripper's
    opening in [0, 1], 1 = open. An observation has the part `joints`, (D,) rad, and `tquat`, (7,),
    the pose of the hand in the frame of the arm's base, m and quaternion xyzw; with two arms these
    are `left/joints` and so on. `contract`, `joint_names`, `joint_limits` and `operator` describe
    the arm to the loop and to the check of a robot. The physics advance with `clock` whenever a
    method is called. `simulated` is True, so that a stop ends by itself.

    Args:
        model: A name of `ARMS` or of the MuJoCo Menagerie, or the path of an MJCF or URDF file.
            Names need the package `mujoco-menagerie`, which downloads a model at its first use, or
            finds it in the folder MENAGERIE_ROOT.
        like: The name of an arm in `ARMS` whose rest pose, gripper and arms also apply to the file.
        cameras: Names of the cameras. "front" looks at the arm; the others are mounted on the hands
            of the arms in turn.
        size: Height and width of the pictures, px.
        fps: The rate of the cameras, Hz.
        delta: Whether actions are relative to the joints' last targets.
        latency_s: The time from `apply` until the controller receives the command, s.
        speed: The largest speed at which the controller moves a joint's target, rad/s.
        clock: The module `time`, or a `SimulatedClock`.

    Raises:
        ConfigError: The model is unknown, or has no arm.
        MissingDependency: MuJoCo or the Menagerie is not installed.
    """

    simulated = True

    def __init__(
        self,
        model: str | Path = "so101",
        *,
        like: str = "",
        cameras: Sequence[str] = ("front", "wrist"),
        size: tuple[int, int] = (120, 160),
        fps: float = 30.0,
        delta: bool = False,
        latency_s: float = 0.03,
        speed: float = 1.5,
        clock: Any = time,
    ) -> None:
        mujoco = require("mujoco", extra="arms", distribution=DISTRIBUTION)
        self._mujoco = mujoco
        arm_model = ARMS.get(like or str(model), ArmModel(str(model)))
        self.clock = clock
        self.delta = delta
        self.speed = speed
        self.arms = arm_model.arms or ("",)

        self._latency_s = latency_s
        # Commands that the controller has not received yet, and the times at which it receives
        # them.
        self._queue: deque[tuple[float, np.ndarray]] = deque()
        # The commanded targets, and the current targets, which approach them at `speed`.
        self._goal = np.zeros(0)
        self._target = np.zeros(0)

        self._size = size
        self._frame_s = 1 / fps
        self._renderer: Any = None
        self._pictures: dict[str, np.ndarray] = {}
        self._pictures_s = -np.inf  # the time of the pictures, s
        # The camera in front of which the operator holds the red card.
        self._card: str | None = None

        spec = _read(mujoco, arm_model, str(model))
        _add_actuators(mujoco, spec)
        # The scene depends on the poses of the hands at rest, so the model is compiled twice.
        self._compile(spec, arm_model)
        self._add_scene(spec, cameras)
        self._compile(spec, arm_model)
        self._cameras = {name: self.model.camera(_PREFIX + name).id for name in cameras}
        self._begun_s = clock.monotonic() - self.data.time

        joints = [drive for drive in self._flat if not drive.gripper]
        self.joint_names = [drive.name for drive in joints]
        self.joint_limits = np.array([(drive.low[0], drive.high[0]) for drive in joints])
        self.operator = SimulatedOperator(self)

        state = {}
        for arm, drives in zip(self.arms, self._drives, strict=True):
            joint_count = sum(not drive.gripper for drive in drives)
            state[arm_part(arm, "joints")] = StateSpec(joint_count, "rad")
            state[arm_part(arm, "tquat")] = StateSpec(7, "m+quat_xyzw")

        has_gripper = len(joints) < len(self._flat)
        self.contract = Contract(
            cameras={name: CameraSpec(*size) for name in cameras},
            state=state,
            gripper=has_gripper,
            action=ActionSpec(
                dim=len(self._flat),
                space="joint",
                delta=delta,
                gripper_open=1.0 if has_gripper else None,
                gripper_closed=0.0 if has_gripper else None,
                arms=self.arms if self.arms != ("",) else None,
            ),
        )

    def observe(self) -> Obs:
        """Return the present measurements of encoders and cameras."""
        self._advance()
        now_s = self.clock.monotonic()
        if now_s - self._pictures_s >= self._frame_s:
            self._pictures = self.render()
            self._pictures_s = now_s

        state: dict[str, np.ndarray] = {}
        openings: list[float] = []
        for number, (arm, drives) in enumerate(zip(self.arms, self._drives, strict=True)):
            measured = [self._measured(drive) for drive in drives if not drive.gripper]
            state[arm_part(arm, "joints")] = np.array(measured, np.float32)
            state[arm_part(arm, "tquat")] = self.hand_pose(number)
            openings += [self._measured(drive) for drive in drives if drive.gripper]

        opening = float(np.clip(np.mean(openings), 0, 1)) if openings else None
        images = {name: picture.copy() for name, picture in self._pictures.items()}
        return Obs(images, opening, state, {CAPTURED: self.clock.time()})

    def apply(self, action: np.ndarray) -> None:
        """Command the targets, which the controller receives after the latency."""
        action = np.asarray(action, np.float64)
        if action.shape != (len(self._flat),):
            raise InvalidAction(
                f"action: expected shape ({len(self._flat)},), got {action.shape}; see the contract"
            )

        self._advance()
        self._queue.append((self._now() + self._latency_s, action))

    def stop(self) -> None:
        """Make the measured positions the targets; the gripper keeps its last command."""
        self._advance()
        last = self._queue[-1][1] if self._queue else self._goal
        self._queue.clear()
        targets = []
        for i, drive in enumerate(self._flat):
            targets.append(last[i] if drive.gripper else self._measured(drive))
        self._goal = np.array(targets)
        self._target = self._goal

    def close(self) -> None:
        """Release the renderer of the cameras."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def joints(self) -> np.ndarray:
        """Return the true positions of the joints of `joint_names`, (D,) rad."""
        self._advance()
        return np.array([self._measured(drive) for drive in self._flat if not drive.gripper])

    def opening(self) -> float:
        """Return the true opening of the grippers in [0, 1]."""
        self._advance()
        openings = [self._measured(drive) for drive in self._flat if drive.gripper]
        return float(np.mean(openings or [1.0]))

    def hand_pose(self, number: int = 0) -> np.ndarray:
        """Return the pose of the hand of an arm in the frame of its base, (7,) m and quaternion
        xyzw.
        """
        position, rotation = self._pose(self._hands[number])
        base_position, base_rotation = self._pose(self._bases[number])

        position_in_base = base_rotation.T @ (position - base_position)
        quaternion = np.zeros(4)  # wxyz, as MuJoCo writes it
        self._mujoco.mju_mat2Quat(quaternion, (base_rotation.T @ rotation).ravel())
        return np.array([*position_in_base, *quaternion[1:], quaternion[0]], np.float32)

    def hold_card(self, camera: str | None) -> None:
        """Show something red in the upper left of the picture of a camera; None takes it away."""
        self._card = camera
        self._pictures_s = -np.inf  # makes the next observation render new pictures

    def render(self) -> dict[str, np.ndarray]:
        """Return the present pictures of all cameras, (H, W, 3) uint8 RGB."""
        if self._renderer is None and self._cameras:
            self._renderer = self._mujoco.Renderer(self.model, *self._size)
            # Shadows would double the time of a picture.
            self._renderer.scene.flags[self._mujoco.mjtRndFlag.mjRND_SHADOW] = False

        pictures = {}
        for name, index in self._cameras.items():
            self._renderer.update_scene(self.data, index)
            picture = self._renderer.render()
            pictures[name] = picture
            if name == self._card:
                height, width = np.array(picture.shape[:2]) // 8
                picture[height : 3 * height, width : 3 * width] = _RED
        return pictures

    def _now(self) -> float:
        """Return the present time of the simulation, s."""
        return float(self.clock.monotonic() - self._begun_s)

    def _advance(self) -> None:
        """Advance the physics to the present time."""
        now_s = self._now()
        step_s = self.model.opt.timestep
        while self.data.time + step_s <= now_s:
            while self._queue and self._queue[0][0] <= self.data.time:
                _, action = self._queue.popleft()
                relative = [self.delta and not drive.gripper for drive in self._flat]
                goal = np.where(relative, self._goal + action, action)
                low, high = np.transpose([drive.limits for drive in self._flat])
                self._goal = np.clip(goal, low, high)

            max_change = self.speed * step_s
            change = np.clip(self._goal - self._target, -max_change, max_change)
            self._target = self._target + change
            self._control(self._target)
            self._mujoco.mj_step(self.model, self.data)

    def _control(self, targets: np.ndarray) -> None:
        """Set the controls of the actuators for the targets of an action, (D,)."""
        for drive, target in zip(self._flat, targets, strict=True):
            for actuator, low, high in zip(drive.actuators, drive.low, drive.high, strict=True):
                self.data.ctrl[actuator] = low + target * (high - low) if drive.gripper else target

    def _measured(self, drive: _Drive) -> float:
        """Return the measured position of a joint, rad, or the opening of a gripper."""
        actuator, low, high = drive.actuators[0], drive.low[0], drive.high[0]
        length = float(self.data.actuator_length[actuator])
        if not drive.gripper:
            return length

        stiffness = self.model.actuator_biasprm[actuator, 1]
        gain = self.model.actuator_gainprm[actuator, 0]
        control = -length * float(stiffness / gain)
        return (control - low) / (high - low)

    def _compile(self, spec: Any, arm_model: ArmModel) -> None:
        """Compile a model, read its actuators, hands and bases, and move it to the rest pose."""
        self.model = spec.compile()
        self.data = self._mujoco.MjData(self.model)
        self._drives = self._read_drives(arm_model)
        self._flat: list[_Drive] = []
        for drives in self._drives:
            self._flat += drives

        self._hands: list[int] = []
        for drives in self._drives:
            joint_drives = [drive for drive in drives if not drive.gripper]
            if not joint_drives:
                raise ConfigError(
                    f"{arm_model.menagerie}: expected joints that move, got none; name the file "
                    "of an arm"
                )
            # The hand is the body that the arm's last joint moves.
            last_joint = int(self.model.actuator_trnid[joint_drives[-1].actuators[0], 0])
            self._hands.append(int(self.model.jnt_bodyid[last_joint]))
        self._bases = [int(self.model.body_rootid[hand]) for hand in self._hands]

        self._rest(arm_model)

    def _add_scene(self, spec: Any, cameras: Sequence[str]) -> None:
        """Add a floor, a light and the cameras: "front" in the world, the others on the hands."""
        # Everything further than 1 cm from a camera is drawn.
        spec.stat.extent = 1.0
        spec.visual.map.znear = 0.01

        world = spec.worldbody
        world.add_light(pos=[0, 0, 3], dir=[0.2, 0.1, -1])
        # The floor collides with nothing. With `contype` 0 too, MuJoCo would treat it as a visual
        # geom, and discard it in a model from a URDF file.
        floor = {"size": [3, 3, 0.1], "pos": [0, 0, -0.01], "contype": 1 << 20, "conaffinity": 0}
        world.add_geom(type=self._mujoco.mjtGeom.mjGEOM_PLANE, rgba=[0.45, 0.45, 0.42, 1], **floor)

        hands = [self._pose(hand) for hand in self._hands]
        hand_positions = [position for position, _ in hands]
        base_positions = [self.data.xpos[base] for base in self._bases]
        centre = np.mean(hand_positions + base_positions, axis=0)
        reach = 0.0
        for hand_position, base_position in zip(hand_positions, base_positions, strict=True):
            reach = max(reach, float(np.linalg.norm(hand_position - base_position)))

        arm = 0  # the arm whose hand gets the next camera
        for name in cameras:
            if name == "front":
                away = np.array([1.5, 1.0, 1.0]) * reach
                camera = {"pos": centre + away, "quat": self._looking(-away, np.eye(3))}
                world.add_camera(name=_PREFIX + name, fovy=60, **camera)
                continue

            hand, base = self._hands[arm], self._bases[arm]
            arm = (arm + 1) % len(hands)
            position, rotation = self._pose(hand)
            out = (position - self.data.xpos[base]) * [1, 1, 0]
            up = np.array([0, 0, 0.12])
            view = 0.15 * out / max(1e-3, float(np.linalg.norm(out))) - 1.5 * up
            camera = {"pos": rotation.T @ up, "quat": self._looking(view, rotation)}
            spec.body(self.model.body(hand).name).add_camera(name=_PREFIX + name, fovy=75, **camera)

    def _looking(self, view: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """Return the rotation of a camera.

        Args:
            view: The direction into which it looks, in the world, (3,).
            frame: The rotation of the frame in which it is mounted, (3, 3).

        Returns:
            The rotation in that frame, a quaternion wxyz, (4,).
        """
        back = -view / np.linalg.norm(view)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(back, right), back], 1)

        quaternion = np.zeros(4)
        self._mujoco.mju_mat2Quat(quaternion, (frame.T @ rotation).ravel())
        return quaternion

    def _rest(self, arm_model: ArmModel) -> None:
        """Begin at the rest pose with open grippers, and let the arm settle."""
        if self.model.nkey:
            self._mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self._mujoco.mj_forward(self.model, self.data)

        rest_pose = iter(arm_model.rest)
        goal = []
        for drive in self._flat:
            goal.append(1.0 if drive.gripper else next(rest_pose, self._measured(drive)))

        for drive, target in zip(self._flat, goal, strict=True):
            joint = int(self.model.actuator_trnid[drive.actuators[0], 0])
            if not drive.gripper:
                self.data.qpos[self.model.jnt_qposadr[joint]] = target

        self._goal = np.array(goal)
        self._target = self._goal
        self._control(self._goal)
        while self.data.time < _SETTLING_S:
            self._mujoco.mj_step(self.model, self.data)

    def _read_drives(self, arm_model: ArmModel) -> list[list[_Drive]]:
        """Return the drives of each arm, in the order of an action: the joints, and the gripper if
        there is one.
        """
        joints_of_arms: list[list[_Drive]] = [[] for _ in self.arms]
        grippers = [_Drive("gripper", gripper=True) for _ in self.arms]

        for index in range(self.model.nu):
            moves_joint = self.model.actuator_trntype[index] == self._mujoco.mjtTrn.mjTRN_JOINT
            joint = ""
            if moves_joint:
                joint = self.model.joint(int(self.model.actuator_trnid[index, 0])).name
            name = self.model.actuator(index).name or joint
            if self.model.actuator_biasprm[index, 1] == 0:
                raise ConfigError(
                    f"{arm_model.menagerie}: actuator {name!r}: expected a position controller, "
                    "got none; give each actuator a position controller"
                )

            low, high = map(float, self.model.actuator_ctrlrange[index])
            if moves_joint and low >= high:  # not limited
                joint_range = self.model.jnt_range[self.model.actuator_trnid[index, 0]]
                if joint_range[0] >= joint_range[1]:
                    joint_range = (-2 * np.pi, 2 * np.pi)
                low, high = map(float, joint_range)

            arm = self._arm_of(f"{name} {joint}")
            if _GRIPPER.search(name) or _GRIPPER.search(joint) or not moves_joint:
                # If two fingers move in opposite directions, one of them is open at its lower
                # limit.
                rising = arm_model.open_high if abs(high) >= abs(low) else not arm_model.open_high
                drive = grippers[arm]
                drive.low.append(low if rising else high)
                drive.high.append(high if rising else low)
            else:
                drive = _Drive(name, low=[low], high=[high])
                joints_of_arms[arm].append(drive)
            drive.actuators.append(index)

        for joints, gripper in zip(joints_of_arms, grippers, strict=True):
            if gripper.actuators:
                joints.append(gripper)
        return joints_of_arms

    def _arm_of(self, names: str) -> int:
        """Return the index of the arm whose name the names of an actuator and its joint contain."""
        for i, arm in enumerate(self.arms):
            if arm and arm in names:
                return i
        return 0

    def _pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the position, (3,), and the rotation, (3, 3), of a body in the world."""
        return self.data.xpos[body], self.data.xmat[body].reshape(3, 3)


def _read(mujoco: Any, arm_model: ArmModel, model: str) -> Any:
    """Return the specification of a model, which MuJoCo can compile.

    Raises:
        ConfigError: The model is unknown, or its file does not exist.
    """
    file = Path(model)
    if file.suffix not in (".xml", ".mjcf", ".urdf"):
        menagerie = require("mujoco_menagerie", extra="arms", distribution=DISTRIBUTION)
        menagerie_names = menagerie.names()
        if arm_model.menagerie not in menagerie_names:
            raise ConfigError(
                f"arm: expected one of {list(ARMS)}, a model of the MuJoCo Menagerie, or the path "
                "of an MJCF or URDF file, got "
                f"{model!r}{did_you_mean(model, [*ARMS, *menagerie_names])}"
            )

        robot = menagerie.get(arm_model.menagerie)
        try:
            return robot.spec(robot.default_model)
        except menagerie.MenagerieError as error:
            cure = (
                "without a network, set MENAGERIE_ROOT to a folder with the models, or give the "
                "path of a file"
            )
            raise ConfigError(
                f"arm {model!r}: the MuJoCo Menagerie has no file of it here ({error}); {cure}"
            ) from error

    if not file.is_file():
        raise ConfigError(
            f"arm: expected a file, got {model!r}, which does not exist; check the path"
        )
    if file.suffix != ".urdf":
        return mujoco.MjSpec.from_file(str(file))

    compiler = (
        f'<compiler meshdir="{file.absolute().parent}" strippath="false" fusestatic="false"/>'
    )
    text = re.sub(r"(<robot[^>]*>)", rf"\1<mujoco>{compiler}</mujoco>", file.read_text(), count=1)
    return mujoco.MjSpec.from_string(text.replace("package://", ""))


def _add_actuators(mujoco: Any, spec: Any) -> None:
    """Add a position controller to each joint of a model without actuators, such as a URDF, and
    compensate gravity.
    """
    if spec.actuators:
        return

    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for body in spec.bodies:
        body.gravcomp = 1
    for joint in spec.joints:
        joint.armature = 0.1
        spec.add_actuator(
            name=joint.name,
            target=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[_KP, *[0] * 9],
            biasprm=[0, -_KP, -_KV, *[0] * 7],
            ctrlrange=joint.range if joint.range[0] < joint.range[1] else [-np.pi, np.pi],
            ctrllimited=True,
        )


class SimulatedOperator(Operator):
    """An operator at a simulated arm, who agrees to every motion, and whose answers are read from
    the simulation.

    Args:
        arm: The arm.
    """

    def __init__(self, arm: MujocoArm) -> None:
        self._arm = arm
        self._before = arm.joints()

    def agrees(self, motion: str) -> bool:
        self._before = self._arm.joints()
        return True

    def holds_card(self, camera: str | None) -> bool:
        self._arm.hold_card(camera)
        return True

    def saw_joint(self, name: str, side: int) -> bool | None:
        moved = self._arm.joints() - self._before
        joint = int(np.argmax(np.abs(moved)))
        return self._arm.joint_names[joint] == name and bool(moved[joint] * side > 0)

    def saw_closing(self) -> bool | None:
        return self._arm.opening() < 0.5

    def sees_hand(self, pose: np.ndarray, arm: int = 0) -> bool | None:
        """Return whether the hand is within 10 cm and about 25° of a pose in the frame of the arm's
        base.
        """
        true_pose = self._arm.hand_pose(arm)
        is_near = np.linalg.norm(true_pose[:3] - pose[:3]) < 0.1
        is_turned_alike = abs(true_pose[3:] @ pose[3:]) > 0.975
        return bool(is_near and is_turned_alike)
