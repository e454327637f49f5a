"""Twenty faults of a robot's driver, as wrappers of a simulated arm."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray_robot.mujoco_arm import MujocoArm


class FaultyArm:
    """A driver of a simulated arm; each subclass has a fault."""

    simulated = True

    def __init__(self, arm: MujocoArm) -> None:
        self.arm, self.clock = arm, arm.clock
        self.contract, self.joint_names, self.joint_limits = (
            arm.contract,
            arm.joint_names,
            arm.joint_limits,
        )

    def observe(self) -> Obs:
        return self.arm.observe()

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(action)

    def stop(self) -> None:
        self.arm.stop()

    def _state(self, change: Callable[[np.ndarray], np.ndarray], part: str = "joints") -> Obs:
        obs = self.arm.observe()
        return replace(obs, state={**obs.state, part: change(obs.state[part].copy())})

    def _picture(self, change: Callable[[np.ndarray], np.ndarray], camera: str = "front") -> Obs:
        obs = self.arm.observe()
        return replace(obs, cameras={**obs.cameras, camera: change(obs.cameras[camera])})


class WrongOrder(FaultyArm):
    """Two joints have each other's names, both in observations and in actions."""

    def _swapped(self, joints: np.ndarray) -> np.ndarray:
        joints = np.array(joints)
        joints[[1, 2]] = joints[[2, 1]]
        return joints

    def observe(self) -> Obs:
        return self._state(self._swapped)

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(self._swapped(action))


class WrongSign(FaultyArm):
    """A joint has the opposite sign, both in observations and in actions."""

    def _inverted(self, joints: np.ndarray) -> np.ndarray:
        joints = np.array(joints)
        joints[1] *= -1
        return joints

    def observe(self) -> Obs:
        return self._state(self._inverted)

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(self._inverted(action))


class Degrees(FaultyArm):
    def observe(self) -> Obs:
        return self._state(lambda joints: np.rad2deg(joints).astype(np.float32))

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(
            np.array(
                [*np.deg2rad(action[: len(self.joint_names)]), *action[len(self.joint_names) :]]
            )
        )


class SwappedCameras(FaultyArm):
    def observe(self) -> Obs:
        obs = self.arm.observe()
        return replace(obs, cameras={"front": obs.cameras["wrist"], "wrist": obs.cameras["front"]})


class Bgr(FaultyArm):
    def observe(self) -> Obs:
        return self._picture(lambda image: image[..., ::-1])


class Mirrored(FaultyArm):
    def observe(self) -> Obs:
        return self._picture(lambda image: image[:, ::-1], "wrist")


class Frozen(FaultyArm):
    first: np.ndarray | None = None

    def observe(self) -> Obs:
        def frozen(image: np.ndarray) -> np.ndarray:
            self.first = image if self.first is None else self.first
            return self.first

        return self._picture(frozen)


class LateState(FaultyArm):
    """The joints were measured 0.7 s ago, but have the present time stamp."""

    def __init__(self, arm: MujocoArm) -> None:
        super().__init__(arm)
        self._old: deque[tuple[float, np.ndarray]] = deque()

    def observe(self) -> Obs:
        def late(joints: np.ndarray) -> np.ndarray:
            now = self.clock.monotonic()
            self._old.append((now, joints))
            while len(self._old) > 1 and self._old[1][0] <= now - 0.7:
                self._old.popleft()
            return self._old[0][1]

        return self._state(late)


class GripperInverted(FaultyArm):
    """Both the command and the measured opening are inverted, so that each agrees with the
    other.
    """

    def observe(self) -> Obs:
        obs = self.arm.observe()
        return replace(obs, gripper=1 - (obs.gripper or 0))

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(np.array([*action[:-1], 1 - action[-1]]))


class OffByOne(FaultyArm):
    """Each number is sent to the next joint, as if the base counted as a joint."""

    def apply(self, action: np.ndarray) -> None:
        count = len(self.joint_names)
        held = self.arm.joints()
        # Only the changes are shifted, so that no joint jumps at first.
        held[1:] += action[: count - 1] - held[: count - 1]
        self.arm.apply(np.array([*held, *action[count:]]))


class OtherLimits(FaultyArm):
    """The limits of an xArm7 for a Franka, whose fourth joint is outside them."""

    def __init__(self, arm: MujocoArm) -> None:
        super().__init__(arm)
        self.joint_limits = np.array([[-6.28, 6.28], [-2.06, 2.09]] * 3 + [[-6.28, 6.28]])
        self.joint_limits[3] = [-0.19, 3.93]


class RelativeForAbsolute(FaultyArm):
    """The driver adds each action to the present joints."""

    def apply(self, action: np.ndarray) -> None:
        count = len(self.joint_names)
        self.arm.apply(np.array([*(self.arm.joints() + action[:count]), *action[count:]]))


class WrongRate(FaultyArm):
    """The arm's own loop runs at 5 Hz: only then it reads joints and accepts the newest command."""

    def __init__(self, arm: MujocoArm) -> None:
        super().__init__(arm)
        self._read_s, self._read = -1.0, arm.observe()
        self._action: np.ndarray | None = None

    def observe(self) -> Obs:
        now = self.clock.monotonic()
        fresh = self.arm.observe()
        if now - self._read_s >= 0.2:
            self._read_s, self._read = now, fresh
            if self._action is not None:
                self.arm.apply(self._action)
                self._action = None
        return replace(fresh, state=self._read.state)

    def apply(self, action: np.ndarray) -> None:
        self._action = action

    def stop(self) -> None:
        self._action = None
        self.arm.stop()


class QuaternionOrder(FaultyArm):
    """The pose has wxyz in place of xyzw."""

    def observe(self) -> Obs:
        return self._state(lambda pose: pose[[0, 1, 2, 6, 3, 4, 5]], "tquat")


class BaseTurned(FaultyArm):
    """The pose is in a frame that is turned by 90° about the vertical."""

    def observe(self) -> Obs:
        return self._state(
            lambda pose: np.array([-pose[1], pose[0], *pose[2:]], np.float32), "tquat"
        )


class NoStop(FaultyArm):
    def stop(self) -> None:
        pass


class Blocking(FaultyArm):
    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(action)
        self.clock.sleep(0.15)


class ClockStep(FaultyArm):
    """The clock steps back by 2 s when it is synchronized, after 10 observations."""

    seen = 0

    def observe(self) -> Obs:
        self.seen += 1
        obs = self.arm.observe()
        return replace(
            obs, info={**obs.info, CAPTURED: obs.info[CAPTURED] - (2.0 if self.seen > 10 else 0.0)}
        )


class Dropped(FaultyArm):
    """The bus loses every third command."""

    sent = 0

    def apply(self, action: np.ndarray) -> None:
        self.sent += 1
        if self.sent % 3:
            self.arm.apply(action)


class Doubled(FaultyArm):
    """The bus of an arm with relative actions sends each command twice."""

    def apply(self, action: np.ndarray) -> None:
        self.arm.apply(action)
        self.arm.apply(action)


@dataclass(frozen=True)
class Fault:
    """A fault, the check that must find it, and whether it must be found before any motion."""

    kind: type[FaultyArm]
    check: str
    at_rest: bool
    arm: str = "franka"
    delta: bool = False

    @property
    def options(self) -> dict[str, Any]:
        return {"delta": self.delta}


FAULTS = (
    Fault(WrongOrder, "order", False),
    Fault(WrongSign, "order", False),
    Fault(Degrees, "units", True),
    Fault(SwappedCameras, "cameras", True),
    Fault(Bgr, "cameras", True),
    Fault(Mirrored, "cameras", True),
    Fault(Frozen, "cameras", True),
    Fault(LateState, "latency", False),
    Fault(GripperInverted, "gripper", False),
    Fault(OffByOne, "order", False),
    Fault(OtherLimits, "limits", True),
    Fault(RelativeForAbsolute, "meaning", False),
    Fault(WrongRate, "rate", False),
    Fault(QuaternionOrder, "place", True),
    Fault(BaseTurned, "place", True),
    Fault(NoStop, "stop", False),
    Fault(Blocking, "blocking", False),
    Fault(ClockStep, "clock", True),
    Fault(Dropped, "commands", False),
    Fault(Doubled, "size", False, delta=True),
)
