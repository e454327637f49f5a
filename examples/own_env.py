"""Wrap your own simulator, so that policies are evaluated in it.

`Crane` is the simulator, with other units, colours and conventions than this project. You write
`CraneEnv`. In the folder of this file, `python own_env.py` checks it, and `vlagents-ray eval
own_env:CraneEnv --policy NAME --out runs/crane` evaluates a policy in it. own_policy.py contains a
policy that solves the task. `vlagents-ray init env NAME` writes a skeleton with its test.
"""

import numpy as np

from vlagents_ray import ActionSpec, CameraSpec, Contract, Obs, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import one_row
from vlagents_ray.testing import check_env


class Crane:
    """A hook over a floor of 1 x 1 m, and a camera that is mounted with a rotation about its
    axis.
    """

    def load(self, seed, camera_turn):
        self.hook, self.mark = np.random.default_rng(seed).uniform(-450, 450, (2, 2))  # mm
        turn = np.deg2rad(camera_turn)
        self._to_picture = (
            np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) / 1500
        )

    def drive(self, dx, dy):  # mm
        self.hook = np.clip(self.hook + np.array([dx, dy]), -500, 500)

    def photo(self, side):  # (side, side, 3) uint8, BGR
        photo = np.full((side, side, 3), 90, np.uint8)
        for place, colour, size in ((self.mark, (0, 255, 0), 3), (self.hook, (0, 0, 255), 2)):
            x, y = ((self._to_picture @ place + 0.5) * side).astype(int)
            photo[max(y - size, 0) : y + size, max(x - size, 0) : x + size] = colour
        return photo


class CraneEnv(EvalEnv):
    """The task: move the hook to within 5 cm of the mark."""

    max_steps = 40  # number of steps after which an episode is truncated
    STEP_MM = 80  # distance by which an action of 1 moves the hook

    # Image size, px, and rotation of the camera, degrees: `--env-set camera_turn=0`.
    def __init__(self, side=96, camera_turn=120):
        self.crane, self.side, self.camera_turn = Crane(), side, camera_turn

    @property
    def contract(self):
        """The observations and actions.

        A policy that does not fit is rejected before the first step.
        """
        return Contract(
            cameras={"front": CameraSpec(self.side, self.side)},
            state={"xy": StateSpec(2, "m")},
            instruction=True,
            action=ActionSpec(dim=2, space="ee_position", delta=True, low=-1.0, high=1.0),
            control_hz=5.0,
        )

    @property
    def instruction(self):
        return "move the hook to the mark"

    def reset(self, *, seed, options=None):
        """Begin the episode of this seed, which does not depend on earlier episodes or the
        process.
        """
        self.crane.load(seed, self.camera_turn)
        self.steps = 0
        return self._observe(), {}

    def step(self, act):
        """Execute one action, (2,); rows of a chunk are passed one after the other."""
        before = self._distance()
        self.crane.drive(*(self.STEP_MM * np.clip(one_row(act, self.contract), -1, 1)))
        self.steps += 1
        success = self._distance() < 0.05
        # `terminated` means that the episode cannot continue, and `truncated` that the step limit
        # is reached. Success is reported separately, and is what an evaluation counts.
        return (
            self._observe(),
            before - self._distance(),
            success,
            self.steps >= self.max_steps,
            {"success": success},
        )

    def close(self):
        """Free the simulator."""

    def _distance(self):
        return float(np.linalg.norm(self.crane.hook - self.crane.mark)) / 1000  # m

    def _observe(self):
        # RGB, in new arrays for each observation.
        picture = self.crane.photo(self.side)[..., ::-1].copy()
        return Obs(
            cameras={"front": picture}, state={"xy": (self.crane.hook / 1000).astype(np.float32)}
        )


if __name__ == "__main__":
    check_env(CraneEnv())  # raises an error that lists all problems
    print("CraneEnv keeps its contract")
