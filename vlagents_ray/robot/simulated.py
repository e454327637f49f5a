"""Robots without hardware: a simulated arm for tests of the control loop, and an environment as a
robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.interface import Act, Obs

if TYPE_CHECKING:
    from vlagents_ray.envs.base import EvalEnv

_SIDE = 224  # side of an image whose size the contract does not declare, px
_DOT = 16  # side of the dot, px
_SMOOTHING = 0.5  # share of the distance to its target that a joint moves per tick


class SimulatedRobot:
    """An arm whose joints follow their commands. Its cameras show the first joint as a dot on a
    still image.

    Actions have the `dim` numbers of the policy's contract, and move the joints as its `Columns`
    declare; numbers without a declaration are targets. Observations have the cameras that the
    contract names, with their sizes, and the parts of the state, filled with the joints; without a
    contract they have the cameras `front` and `wrist` and the part `joints`.

    Args:
        contract: The contract of the policy that drives the arm.
    """

    simulated = True

    def __init__(self, contract: Contract | None = None) -> None:
        contract = contract or Contract()
        self._action: ActionSpec = contract.action
        state = contract.state or {"joints": StateSpec()}
        self._state_dims = {name: spec.dim for name, spec in state.items()}

        # Gradients with a little noise, which codecs compress like real camera images.
        self._pictures: dict[str, np.ndarray] = {}
        cameras = contract.cameras or {"front": CameraSpec(), "wrist": CameraSpec()}
        for name, camera in cameras.items():
            height, width = camera.height or _SIDE, camera.width or _SIDE
            y, x = np.mgrid[:height, :width]
            noise = np.random.default_rng(0).integers(0, 8, (height, width))
            channels = [x * 200 // width + noise, y * 200 // height + noise, (x + y) % 160 + noise]
            self._pictures[name] = np.stack(channels, -1).astype(np.uint8)

        self._joints = np.zeros(self._action.dim or 7, np.float32)
        self._columns = Columns.from_spec(self._action, len(self._joints))
        self._target = self._joints.copy()
        self.applied = 0  # the number of applied actions
        self.stopped = False

    def observe(self) -> Obs:
        """Return the current state, in new arrays each time."""
        self._joints = self._joints + _SMOOTHING * (self._target - self._joints)
        state: dict[str, np.ndarray] = {}
        for name, dim in self._state_dims.items():
            size = len(self._joints) if dim is None else dim
            state[name] = np.resize(self._joints, size).astype(np.float32)

        opened, closed = self._action.gripper_open, self._action.gripper_closed
        opening = 1.0
        if opened is not None and closed is not None and opened != closed:
            position = float(self._joints[list(self._columns.grippers)].mean())
            opening = min(1.0, max(0.0, (position - closed) / (opened - closed)))

        # A red dot moves with the first joint.
        images = {name: picture.copy() for name, picture in self._pictures.items()}
        turn = float(self._joints[0])
        for image in images.values():
            height, width = image.shape[:2]
            x = round((0.5 + 0.4 * np.sin(turn)) * (width - _DOT))
            y = round((0.5 + 0.4 * np.cos(turn)) * (height - _DOT))
            image[max(0, y) : y + _DOT, max(0, x) : x + _DOT] = (220, 40, 40)
        return Obs(images, opening, state)

    def apply(self, action: np.ndarray) -> None:
        """Set the targets of the joints, rad."""
        self.applied += 1
        self.stopped = False
        self._target = self._columns.joined(self._target, action)

    def stop(self) -> None:
        """Make the current position of the joints their target; the grippers keep their grasp."""
        target = self._joints.copy()
        grippers = list(self._columns.grippers)
        target[grippers] = self._target[grippers]
        self._target = target
        self.stopped = True


class EnvRobot:
    """One episode of an environment as a `Robot`: each command executes a step; without commands,
    simulated time does not pass.

    Args:
        env: The environment, which the caller closes.
        seed: The seed of the episode.
        endless: Whether to ignore the environment's step limit, since an operator needs more time
            than a policy.
    """

    simulated = True

    def __init__(self, env: EvalEnv, seed: int, *, endless: bool = False) -> None:
        self._env = env
        self._endless = endless
        self._obs, _ = env.reset(seed=seed)
        self.success = False  # the task was solved
        self.ended = False  # the task was solved, or the environment ended the episode
        self.steps = 0  # the number of applied actions

    def observe(self) -> Obs:
        """Return the observation after the last step."""
        return self._obs

    def apply(self, action: np.ndarray) -> None:
        """Execute a step, if the episode has not ended."""
        if self.ended:
            return
        self._obs, _, terminated, truncated, info = self._env.step(Act(action))
        self.steps += 1
        self.success = bool(info.get("success", False))
        self.ended = self.success or terminated or (truncated and not self._endless)

    def stop(self) -> None:
        """Do nothing: the simulation executes steps only on command."""
