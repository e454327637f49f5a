"""The built-in tabletop: coloured pucks and pads, a gripper, and instructions about them.

It needs only numpy, without a simulator or a graphics driver, so that a first run works anywhere.

Base frame: origin in the middle of the table's surface, x to the right in the image, y away from
the camera, z up; metres. The camera "front" looks down at an elevation of 70 degrees without
perspective: the view's shorter side spans 0.66 m and the origin lies in the image's centre, so that

    s = min(width, height) / 0.66  # pixels per metre
    u = width / 2 + s * x
    v = height / 2 - s * (y * sin(elevation) + z * cos(elevation))

The camera "wrist" shows an enlarged third of that image, with the fingertips in its centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import DELTA_POSE, EvalEnv, one_row, require_cameras, require_known
from vlagents_ray.envs.tabletop.render import ELEVATION, VIEW, TabletopRenderer, WristRenderer
from vlagents_ray.envs.tabletop.world import (
    PUCKS,
    STEP_LIMIT,
    Goal,
    TabletopWorld,
    Task,
    draw_episode,
    goals,
)
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.interface import Act, Obs

MIXED = "mixed"
_RENDERERS = {"front": TabletopRenderer, "wrist": WristRenderer}
_TASKS: tuple[Task, ...] = get_args(Task)
_DISTURBED = 0.1  # share of the steps with `disturbance`
# Version of the scenes and the physics; results of different versions are not comparable.
_VERSION = 1
_POINTING_DOWN = (math.pi, 0.0, 0.0)  # constant roll, pitch and yaw of the gripper, rad


class Tabletop(EvalEnv):
    """Four pucks, three pads and an instruction, e.g. "put the red puck on the blue pad".

    Tasks: `pick_place`, `slide` (without lifting the puck), `stack`, `lift`, and `mixed`, the
    default, which draws one of the other tasks for each episode.

    Observation: the cameras "front" and "wrist", by default only "front", (height, width, 3).
    `state["xyzrpy"]` (6,) is the position of the fingertips, m, and the constant orientation of the
    gripper, rad, in the base frame of the package's docstring. `gripper` is in [0, 1], 1 = open,
    and about 0.58 around a puck. With `object_state`, the state also contains `puck` (3,), the
    position of the underside of the instruction's puck, and `target` (3,), its target, both in m
    in the base frame.

    Action: (4,). `dx, dy, dz` in units of 0.03 m per step along the base frame's axes, and the
    gripper, 1 = open, -1 = closed. Values outside [-1, 1] are clipped, as a robot's controller
    does.

    The reward is 1.0 in each step after which the task is solved, and otherwise 0.0. Success ends
    an episode only with `ends_on_success`.
    """

    known = (MIXED, *_TASKS)

    def __init__(
        self,
        task: str | None = None,
        *,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] = ("front",),
        max_steps: int = 80,
        pucks: int = PUCKS,
        object_state: bool = False,
        disturbance: float = 0.0,
        ends_on_success: bool = False,
    ) -> None:
        """Create the environment of a task.

        Args:
            task: One of `tasks()`; None selects `mixed`.
            width: The width of the image, at least 32 pixels.
            height: The height of the image, at least 32 pixels.
            cameras: "front", "wrist" or both.
            max_steps: The number of steps until truncation.
            pucks: The number of pucks on the table, 1 to 4. A policy without instructions can
                identify the right puck only if there is a single puck.
            object_state: Whether the state contains the positions of the puck and of the target in
                the instruction.
            disturbance: Standard deviation of the noise that is added to the motion in a tenth of
                the steps, in units of an action. Demonstrations with such noise show how to recover
                from errors (DART, arXiv 1703.09327).
            ends_on_success: Whether to report `terminated` when the task is solved.

        Raises:
            ConfigError: The task is unknown, or a number is out of range.
        """
        self.require_task(task)
        self._task = task or MIXED
        self._tasks = [name for name in _TASKS if self._task in (MIXED, name)]
        fewest_pucks = 2 if self._task in (MIXED, "stack") else 1
        self._require_in_range("width", width, 32)
        self._require_in_range("height", height, 32)
        self._require_in_range("max_steps", max_steps, 1)
        self._require_in_range("pucks", pucks, fewest_pucks, PUCKS)
        self._require_in_range("disturbance", disturbance, 0, 1)
        require_cameras("tabletop", cameras, _RENDERERS)

        self.max_steps, self._disturbance = max_steps, disturbance
        self._pucks, self._object_state = pucks, object_state
        self._ends_on_success = ends_on_success
        self._contract = self.known_contract(
            {"width": width, "height": height, "cameras": cameras, "object_state": object_state}
        )
        self._renderers = {name: _RENDERERS[name](width, height) for name in cameras}

        # Variables of the current episode.
        self._draws = np.random.default_rng()
        self._world: TabletopWorld | None = None
        self._goal: Goal | None = None
        self._steps = 0

    def _require_in_range(
        self, option: str, value: float, low: int, high: int | None = None
    ) -> None:
        """Raise `ConfigError` if an option is below `low`, or above `high` if `high` is not
        None.
        """
        if value >= low and (high is None or value <= high):
            return
        allowed = f"at least {low}" if high is None else f"{low} to {high} in {self._task!r}"
        raise ConfigError(f"tabletop: {option}: expected {allowed}, got {value}")

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("tabletop", task or MIXED, cls.tasks())

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract of the environment with these arguments of the constructor."""
        camera = CameraSpec(arguments["height"], arguments["width"])
        state = {"xyzrpy": StateSpec(6, "m+rad")}
        if arguments.get("object_state"):
            state |= {"puck": StateSpec(3, "m"), "target": StateSpec(3, "m")}
        action = replace(
            DELTA_POSE,
            dim=4,
            space="ee_position",
            rotation="none",
            gripper_open=1.0,
            gripper_closed=-1.0,
        )
        return Contract(
            cameras=dict.fromkeys(arguments.get("cameras", ("front",)), camera),
            state=state,
            gripper=True,
            instruction=True,
            action=action,
            control_hz=10.0,
        )

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        if self._goal is None:
            raise NotReset("tabletop: there is no instruction before the first reset(seed=...)")
        return self._goal.instruction

    def describe(self) -> dict[str, Any]:
        """Return the version of the scenes and the physics, the task, and the camera."""
        return {
            "version": _VERSION,
            "task": self._task,
            "control_mode": "ee_delta_position",
            "metres_per_unit": STEP_LIMIT,
            "camera": {"elevation_deg": round(math.degrees(ELEVATION), 6), "view_m": VIEW},
            "numpy": np.__version__,
        }

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode. The only option is `instruction`, which selects another goal in the
        same scene.

        `info["instructions"]` lists the instructions of the episode's task that are possible in
        this scene.
        """
        unknown = sorted(set(options or {}) - {"instruction"})
        if unknown:
            raise ConfigError(
                f"tabletop: expected the reset option 'instruction' or none, got {unknown}; leave "
                "these out"
            )

        rng = np.random.default_rng(seed % 2**64)  # Numpy accepts no negative seed.
        task = self._tasks[rng.integers(len(_TASKS)) if self._task == MIXED else 0]
        world, goal = draw_episode(task, rng, self._pucks)
        if options:
            goal = self._chosen(world, options["instruction"])

        self._world, self._goal, self._steps, self._draws = world, goal, 0, rng
        for renderer in self._renderers.values():
            renderer.begin(world.pads)
        instructions = [possible.instruction for possible in goals(world, goal.task)]
        info = {"instructions": instructions, "success": False}
        return self._observe(world, goal), info

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action, (4,); see `EvalEnv.step`."""
        world, goal = self._world, self._goal
        if world is None or goal is None:
            raise NotReset("tabletop: step was called before reset; call reset(seed=...) first")

        action = one_row(act, self._contract)
        if self._disturbance and self._draws.random() < _DISTURBED:
            action = action + np.append(self._draws.normal(0.0, self._disturbance, 3), 0.0)
        dx, dy, dz, grip = np.clip(action, -1.0, 1.0).tolist()
        world.step(dx * STEP_LIMIT, dy * STEP_LIMIT, dz * STEP_LIMIT, (grip + 1) / 2)
        self._steps += 1

        success = goal.is_reached(world)
        obs = self._observe(world, goal, look=self.looked_at)
        terminated = success and self._ends_on_success
        truncated = self._steps >= self.max_steps
        return obs, float(success), terminated, truncated, {"success": success}

    def close(self) -> None:
        self._world = self._goal = None

    def _observe(self, world: TabletopWorld, goal: Goal, *, look: bool = True) -> Obs:
        """Return the current observation; without `look` it has no images."""
        state = {"xyzrpy": np.array((world.x, world.y, world.z, *_POINTING_DOWN), np.float32)}
        if self._object_state:
            puck = world.puck(goal.puck)
            state["puck"] = np.array((puck.x, puck.y, puck.z), np.float32)
            state["target"] = np.array(goal.target_position(world), np.float32)

        cameras = {}
        if look:
            cameras = {name: renderer.draw(world) for name, renderer in self._renderers.items()}
        return Obs(cameras=cameras, gripper=world.opening, state=state)

    def _chosen(self, world: TabletopWorld, instruction: object) -> Goal:
        """Return the goal of an instruction; raises `ConfigError` if the scene has no such goal."""
        possible: dict[str, Goal] = {}
        for task in self._tasks:
            possible |= {goal.instruction: goal for goal in goals(world, task)}
        if instruction not in possible:
            raise ConfigError(
                f"tabletop: expected an instruction of this scene, one of {list(possible)}, got "
                f"{instruction!r}"
            )
        return possible[str(instruction)]
