"""Robots of LeRobot for the control loop: `--robot lerobot:so101_follower`."""

from __future__ import annotations

import contextlib
import functools
import importlib
import itertools
import logging
import pkgutil
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidAction, MissingDependency
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require

logger = logging.getLogger(__name__)


class OneAtATime:
    """A bus of motors whose methods run one at a time.

    LeRobot's buses have no lock, and the watchdog's thread may stop a robot during a transfer of
    the control loop. Each call is locked separately, so that a stop waits for a transfer, but not
    for the cameras that are read after the transfer.

    Args:
        bus: The bus of LeRobot.
    """

    def __init__(self, bus: Any) -> None:
        self._bus = bus
        self._lock = threading.RLock()

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._bus, name)
        if not callable(value):
            return value

        @functools.wraps(value)
        def locked(*args: Any, **options: Any) -> Any:
            with self._lock:
                return value(*args, **options)

        return locked


@dataclass(frozen=True, slots=True)
class _Arm:
    """A part of a robot with its own bus, or the whole robot."""

    robot: Any  # LeRobot's robot of this part
    # The names of the arm's motors, without the prefix that they have on a robot with two arms.
    motors: list[str]
    indices: list[int]  # the indices of these motors in an action

    @property
    def bus(self) -> Any:
        """The bus of the arm's motors; None if LeRobot drives them in another way."""
        return getattr(self.robot, "bus", None)


class LeRobotRobot:
    """A robot that LeRobot drives, selected by the name that its configuration registers.

    Joints stay in LeRobot's order and units, which its datasets and policies trained on them also
    have. The part `joints`, (D,), of an observation contains the same joints as an action,
    including the gripper. The motors whose name contains "gripper" keep their goal at a stop, so
    that they do not drop what they hold.

    Args:
        robot_type: The registered name, such as "so101_follower".
        unit: The unit of the joints; default: "deg" or "%" of the calibrated range, depending on
            `use_degrees` in the configuration of the robot, or of its arms.
        settings: The fields of its configuration, such as `port="/dev/ttyACM0"`, `id="my_arm"` and
            `cameras`.

    Raises:
        ConfigError: LeRobot has no such robot, a setting is wrong, or the robot is not calibrated.
        MissingDependency: LeRobot, or the driver of the robot's motors, is not installed.
    """

    _measured: np.ndarray | None = None  # the last measured joints, (D,)
    _goal: np.ndarray | None = None  # the last action, (D,)

    def __init__(self, robot_type: str, *, unit: str = "", **settings: Any) -> None:
        try:
            package = require("lerobot.robots")
        except MissingDependency as error:
            raise MissingDependency(
                f"lerobot:{robot_type}: LeRobot is not installed in this Python; run `pip install "
                "lerobot`, or run `vlagents-ray venv create lerobot` and then this command as "
                "`.venv-lerobot/bin/vlagents-ray ...`"
            ) from error

        for folder in (package, require("lerobot.cameras")):
            for module in pkgutil.iter_modules(folder.__path__):
                # The import registers the module's configurations; it fails if the driver is not
                # installed.
                with contextlib.suppress(ImportError):
                    importlib.import_module(f"{folder.__name__}.{module.name}")
        require("lerobot.utils.import_utils").register_third_party_plugins()

        try:
            config = importlib.import_module("draccus").decode(
                package.RobotConfig, {"type": robot_type, **settings}
            )
            self._robot = require("lerobot.robots.utils").make_robot_from_config(config)
        except Exception as error:
            suggestion = did_you_mean(robot_type, package.RobotConfig.get_known_choices())
            raise ConfigError(
                f"lerobot:{robot_type}: LeRobot rejects the settings {settings} "
                f"({error}){suggestion}"
            ) from error

        not_positions = [name for name in self._robot.action_features if not name.endswith(".pos")]
        if not_positions:
            raise ConfigError(
                f"lerobot:{robot_type}: expected positions of joints (NAME.pos) as actions, got "
                f"{not_positions}"
            )

        self._keys = list(self._robot.action_features)
        self._unit = unit or self._configured_unit(config)

        self._robot.connect(calibrate=False)
        if not self._robot.is_calibrated:
            self._robot.disconnect()
            raise ConfigError(
                f"lerobot:{robot_type}: not calibrated; run lerobot-calibrate "
                f"--robot.type={robot_type} with its id"
            )

        self._lock_buses()

    def _lock_buses(self) -> None:
        """Let the methods of the robot's buses run one at a time."""
        # A robot with two arms has a bus in each of them.
        for arm in (self._robot, *vars(self._robot).values()):
            if hasattr(arm, "bus"):
                arm.bus = OneAtATime(arm.bus)

    @functools.cached_property
    def _arms(self) -> list[_Arm]:
        """The arms that have a bus; the whole robot if not all motors are on these buses.

        LeRobot's robots with two arms have the attributes `left_arm` and `right_arm`, and the
        motors' names have the prefixes "left_" and "right_".
        """
        whole = [_Arm(self._robot, self.joint_names, list(range(len(self._keys))))]
        if hasattr(self._robot, "bus"):
            return whole

        arms = []
        for attribute, robot in vars(self._robot).items():
            if not hasattr(robot, "bus"):
                continue
            prefix = attribute.removesuffix("arm")
            indices = [i for i, name in enumerate(self.joint_names) if name.startswith(prefix)]
            motors = [self.joint_names[i].removeprefix(prefix) for i in indices]
            arms.append(_Arm(robot, motors, indices))
        on_buses = list(itertools.chain.from_iterable(arm.indices for arm in arms))
        return arms if sorted(on_buses) == whole[0].indices else whole

    def _configured_unit(self, config: Any) -> str:
        """Return the unit of the joints according to the configuration of the robot, or of its
        arms.
        """
        units: dict[str, None] = {}
        for arm in self._arms:
            of_arm = config if arm.robot is self._robot else arm.robot.config
            units["deg" if getattr(of_arm, "use_degrees", False) else "%"] = None
        if len(units) > 1:
            raise ConfigError(
                f"use_degrees: expected the same for all arms, got {' and '.join(units)}; set it "
                "for each arm"
            )
        [unit] = units
        return unit

    @property
    def _grippers(self) -> tuple[int, ...]:
        """The indices of the grippers in an action, by the names of the motors."""
        names = enumerate(self.joint_names)
        return tuple(index for index, name in names if "gripper" in name.lower())

    @property
    def joint_names(self) -> list[str]:
        """The names of the motors, in the order of an action."""
        return [key.removesuffix(".pos") for key in self._keys]

    @property
    def joint_limits(self) -> np.ndarray:
        """The limits of the motors from LeRobot's settings and calibration, (D, 2) in the unit of
        the joints; infinite if they are unknown.
        """
        limits = np.empty((len(self._keys), 2))
        for arm in self._arms:
            limits[arm.indices] = [self._limits_of(arm, name) for name in arm.motors]
        return limits

    def _limits_of(self, arm: _Arm, name: str) -> tuple[float, float]:
        """Return the lowest and the highest position of a motor of an arm."""
        config = getattr(arm.robot, "config", None)
        configured = getattr(config, "joint_limits", None) or {}
        if name in configured:
            return configured[name]  # type: ignore[no-any-return]

        bus: Any = arm.bus
        motor: Any = getattr(bus, "motors", {}).get(name)
        calibration: Any = getattr(bus, "calibration", {}).get(name)
        mode = getattr(getattr(motor, "norm_mode", None), "name", "")

        if mode == "DEGREES" and calibration is not None and hasattr(bus, "model_resolution_table"):
            counts = calibration.range_max - calibration.range_min
            half = 180 * counts / (bus.model_resolution_table[motor.model] - 1)
            return -half, half

        limits_by_mode = {"RANGE_M100_100": (-100.0, 100.0), "RANGE_0_100": (0.0, 100.0)}
        return limits_by_mode.get(mode, (-np.inf, np.inf))

    @property
    def contract(self) -> Contract:
        """The cameras, the joints and the actions, from LeRobot's features."""
        cameras = {}
        for name, shape in self._robot.observation_features.items():
            if isinstance(shape, tuple):  # The feature is that of a camera.
                cameras[name] = CameraSpec(*shape[:2])
        return Contract(
            cameras=cameras,
            state={"joints": StateSpec(len(self._keys), self._unit)},
            gripper=False,
            action=ActionSpec(
                dim=len(self._keys),
                space="joint",
                delta=False,
                grippers=self._grippers,
            ),
        )

    def observe(self) -> Obs:
        """Return LeRobot's observation, whose capture time is the beginning of this call."""
        captured_at = time.time()
        readings = self._robot.get_observation()

        joints = np.array([readings[key] for key in self._keys], np.float32)
        self._measured = joints.copy()
        images = {name: np.asarray(readings[name]) for name in self.contract.cameras or {}}
        return Obs(images, None, {"joints": joints}, {CAPTURED: captured_at})

    def apply(self, action: np.ndarray) -> None:
        """Send the goal positions."""
        if np.shape(action) != (len(self._keys),):
            raise InvalidAction(
                f"action: expected shape ({len(self._keys)},), for {self._keys}, got "
                f"{np.shape(action)}"
            )
        self._goal = np.array(action, np.float32)
        self._robot.send_action(dict(zip(self._keys, map(float, action), strict=True)))

    def stop(self) -> None:
        """Make the measured positions the goal; torque stays on, so that the arm does not fall.

        No camera is read. If there is no bus, or the bus cannot be read, the goal is the pose of
        the last observation. The grippers keep their goal, also that of an earlier program. Every
        arm is stopped, even if stopping another arm fails.

        Raises:
            Exception: The motors of an arm cannot be reached, or the robot was commanded and no
                pose is known.
        """
        errors: list[Exception] = []
        for arm in self._arms:
            try:
                self._stop_arm(arm)
            except Exception as error:  # noqa: BLE001 - raised below, after the other arms
                errors.append(error)
        if errors:
            raise errors[0]

    def _stop_arm(self, arm: _Arm) -> None:
        """Make the measured positions of an arm its goal, except those of its grippers."""
        try:
            positions = self._present(arm).copy()
        except Exception as error:
            if self._goal is not None:
                raise
            logger.warning(
                "stop: no pose of the robot is known (%s); it was not commanded, and stays as "
                "it is",
                error,
            )
            return

        goals = dict(zip(arm.motors, map(float, positions), strict=True))
        for name, index in zip(arm.motors, arm.indices, strict=True):
            if index not in self._grippers:
                continue
            if self._goal is None:
                del goals[name]  # the goal of an earlier program is not known, and stays as it is
            else:
                goals[name] = float(self._goal[index])
        try:
            arm.robot.send_action({f"{name}.pos": goal for name, goal in goals.items()})
        except Exception:
            if arm.bus is None:
                raise
            # With max_relative_target, LeRobot reads the positions before it sends a goal.
            arm.bus.sync_write("Goal_Position", goals)

    def _present(self, arm: _Arm) -> np.ndarray:
        """Return the present joints of an arm, if possible without reading a camera."""
        if hasattr(arm.bus, "sync_read"):
            try:
                positions = arm.bus.sync_read("Present_Position")
                return np.array([positions[name] for name in arm.motors], np.float32)
            except Exception as error:
                if self._measured is None:
                    raise
                logger.warning(
                    "stop: the motors' positions cannot be read (%s); the last known positions "
                    "are the goal",
                    error,
                )

        joints = self._measured
        if joints is None:
            joints = self.observe().state["joints"]
        return joints[arm.indices]

    def close(self) -> None:
        """Disconnect; whether torque is released is a setting of LeRobot's configuration."""
        self._robot.disconnect()
