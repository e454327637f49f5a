"""Policies whose chunks are a known function of their input, so that a test can predict LeRobot's
actions.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.interface import DELAY, LEFTOVER

CAMERA, SIDE, HZ, ROWS = "top", 48, 20, 2
COUNT = 1 / 1024  # exact in floating point, and small enough to be a gripper position
CONTRACT = Contract(
    cameras={CAMERA: CameraSpec(SIDE, SIDE)},
    state={"joints": StateSpec(2, "rad")},
    gripper=True,
    instruction=True,
    action=ActionSpec(dim=3, space="joint"),
    control_hz=HZ,
    chunk=ROWS,
)


def colour_of(image: int) -> int:
    """Return the value of all bytes of the robot's image with that number, counted from 1."""
    return image * 37 % 256


def mirrored(state: np.ndarray, colour: int, acts: int, instruction: str) -> np.ndarray:
    """Return the chunk, (2, 3) float32, for a session's call with the number `acts`, counted from
    1.

    Args:
        state: Two joints and the gripper, in [0, 1].
        colour: The value of all bytes of the image.
    """
    shoulder, elbow, gripper = (float(number) for number in state)
    rows = [
        [elbow + row, len(instruction) - shoulder / 2 + acts / 8, (gripper + colour / 255) / 2]
        for row in range(ROWS)
    ]
    return np.array(rows, np.float32)


class MirrorPolicy(Agent):
    """A policy that returns `mirrored` chunks; `begun` has the instruction and the seed of each
    episode.
    """

    contract = CONTRACT
    # Shared by all sessions, which are copies.
    begun: ClassVar[list[tuple[str | None, object]]] = []

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.instruction, self.acts = instruction or "", 0
        self.begun.append((instruction, kwargs.get("seed")))
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        state = np.array([*obs.state["joints"], obs.gripper], np.float32)
        return Act(mirrored(state, int(obs.cameras[CAMERA][0, 0, 0]), self.acts, self.instruction))


class CountingPolicy(Agent):
    """A policy with real-time chunking. Its rows (n, n, n) continue to count in `COUNT` from the
    given plan, or from 1 without a plan.
    """

    contract = replace(CONTRACT, chunk=40)
    continues_plans = True
    longest_prefix = 0
    # Rows, (H, 3), and delay of the plan in each call that has one.
    plans: ClassVar[list[tuple[np.ndarray, int]]] = []

    def act(self, obs: Obs) -> Act:
        plan = obs.info.get(LEFTOVER, np.zeros((0, 3), np.float32))
        if len(plan):
            self.plans.append((plan, obs.info[DELAY]))
        first = plan[0, 0] / COUNT if len(plan) else 1
        return Act(
            np.repeat(np.arange(first, first + 40, dtype=np.float32)[:, None] * COUNT, 3, axis=1)
        )
