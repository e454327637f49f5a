"""Serve your own policy.

`Servo` finds the red hook and the green mark in the image of own_env.py, and moves the hook towards
the mark. Your model replaces its 2 x 2 weights. In the folder of this file,

    python own_policy.py  # checks it, and runs 20 episodes without a server
    vlagents-ray serve own_policy:Servo --set camera_turn=120  # in another terminal
    vlagents-ray eval own_env:CraneEnv --policy http://localhost:8000 --out runs/crane

`vlagents-ray init policy NAME` writes a skeleton with its test and its deployment file.
"""

import time

import numpy as np
from pydantic import BaseModel, Field
from rich.console import Console

from vlagents_ray import Act, ActionSpec, CameraSpec, Contract, TrainableAgent
from vlagents_ray.envs import make_env
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.evaluate import EvalConfig, evaluate, print_summary
from vlagents_ray.testing import check_agent


class ServoConfig(BaseModel, extra="forbid"):
    """The settings: `--set camera_turn=120`, or `config:` in a deployment file.

    Unknown keys are errors.
    """

    camera_turn: float = Field(default=0.0, description="rotation of the mounted camera, degrees")


def offset(picture):
    """Return the vector from hook to mark in an image, (H, W, 3) uint8 RGB: (2,) image widths, x
    right, y down.
    """
    red, green = picture[..., 0] > 200, picture[..., 1] > 200
    if not (red.any() and green.any()):
        raise InvalidObservation(
            "camera 'front': expected a red hook and a green mark in the picture, got one without "
            "both of them; move the camera"
        )
    hook, mark = (np.argwhere(colour).mean(axis=0)[::-1] for colour in (red, green))
    return (mark - hook) / picture.shape[1]


class Servo(TrainableAgent):
    """Moves the hook along the offset in the image, rotated by the mounting angle of the camera."""

    Config = ServoConfig
    trainable = "weights"  # rl_loop.py pushes new values while the policy is served

    def __init__(self, config=None):
        self.config = config or ServoConfig()

    @property
    def contract(self):
        """The inputs and outputs.

        A robot or an environment that does not fit receives an error with the difference.
        """
        return Contract(
            cameras={"front": CameraSpec()},
            action=ActionSpec(dim=2, space="ee_position", delta=True),
        )

    def initialize(self):
        """Load the weights, once in a replica."""
        turn = np.deg2rad(self.config.camera_turn)
        back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        self.weights = {"gain": (10 * back).astype(np.float32)}  # (2, 2), actions per image width

    def reset(self, obs, instruction, spread=0.0, seed=0, **kwargs):
        """Begin an episode on this session's copy; the options come from the client."""
        # Standard deviation of a learner's exploration.
        self.spread, self.rng = spread, np.random.default_rng(seed)
        return {}

    def act_batch(self, obs, sessions):
        """Answer all waiting sessions in one forward pass: `sessions[i]` is the copy for
        `obs[i]`.
        """
        seen = np.stack([offset(one.cameras["front"]) for one in obs])  # (B, 2)
        actions = seen @ self.weights["gain"].T
        tried = [
            session.rng.normal(0, session.spread, 2) if session.spread else 0.0
            for session in sessions
        ]
        return [
            Act((action + noise).astype(np.float32))
            for action, noise in zip(actions, tried, strict=True)
        ]


if __name__ == "__main__":
    env = "own_env:CraneEnv"
    with make_env(env) as crane:
        check_agent(Servo(), obs=crane.reset(seed=0)[0])  # raises an error that lists all problems
    out = time.strftime("runs/servo-%H%M%S")
    plan = EvalConfig(
        policies=[{"name": "servo"}], suites=[{"envs": [env], "episodes": 20}], workers=0, out=out
    )
    summary = evaluate(plan, agent_factory=lambda: Servo(ServoConfig(camera_turn=120)))
    print_summary(Console(), summary)
