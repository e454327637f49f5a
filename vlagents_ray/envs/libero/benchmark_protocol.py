"""The protocol of LIBERO, under which results are comparable with published ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

SETTLE = "settle"
CONTROL_HZ = 20.0  # robosuite's default, and the rate of the demonstrations


@dataclass(frozen=True, slots=True)
class Suite:
    """One of LIBERO's five suites."""

    tasks: int
    max_steps: int  # openpi, examples/libero/main.py; openvla, run_libero_eval.py: above the longest demonstration


SUITES: Mapping[str, Suite] = {
    "libero_spatial": Suite(10, 220),  # longest demonstration: 193
    "libero_object": Suite(10, 280),  # 254
    "libero_goal": Suite(10, 300),  # 270
    "libero_10": Suite(10, 520),  # 505
    "libero_90": Suite(90, 400),  # 373
}


def base_of(suite: str) -> str:
    """The one of the five suites that `suite` is or varies, "libero_goal" of "libero_goal_swap"; "" if it is none."""
    return next((base for base in SUITES if suite == base or suite.startswith(f"{base}_")), "")


@dataclass(frozen=True, slots=True)
class LiberoProtocol:
    """The conventions of an episode; comments say where openpi and OpenVLA differ.

    `max_steps` counts the policy's actions alone: peers count to `max_steps` plus the settling ones.

    The simulator draws whatever an initial state does not determine, such as the place of a cabinet, from
    `simulator_seed`. It is seeded again for each episode, so that an episode does not depend on those
    before it; openpi (7) and OpenVLA (0) seed once a task, so that their scenes shift a little from
    episode to episode.

    MuJoCo's images are upside down. The demonstrations' were turned by 180 degrees for training (OpenVLA,
    regenerate_libero_dataset.py; openpi takes them over), not flipped: they are upright, and mirrored left
    to right. Policies expect that.
    """

    max_steps: int
    settling_steps: int = 10  # openpi and OpenVLA: the objects fall into place
    settling_action: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)  # still, gripper open
    image_size: tuple[int, int] = (256, 256)  # height, width: rendered so by both; policies resize
    cameras: Mapping[str, str] = field(default_factory=lambda: {"front": "agentview", "wrist": "robot0_eye_in_hand"})
    turned_180: Literal[True] = True
    simulator_seed: int = 7  # openpi's
    begins: tuple[str, ...] = ("seed", "reset", "set_init_state", SETTLE)  # in this order, for every episode
    control_hz: float = CONTROL_HZ
    controller: str = "OSC_POSE"  # LIBERO's default: 0.05 m and 0.5 rad a unit, in the robot base's axes
    gripper_open: float = -1.0  # of a policy's action: robosuite's, openpi's; OpenVLA's are 1 and 0
    gripper_closed: float = 1.0
    success: str = "the goal predicates hold after a step"  # LIBERO's `done`
    stop_at_success: bool = True  # both end the episode there

    @classmethod
    def of(cls, suite: str, **changes: Any) -> LiberoProtocol:
        """Return the protocol of a suite with changes; a change that is None is ignored.

        A suite that varies one of the five has its step limit, as LIBERO-PRO's evaluation gives it.
        """
        changed = {name: value for name, value in changes.items() if value is not None}
        return cls(**{"max_steps": SUITES[base_of(suite)].max_steps} | changed)

    def to_json(self, suite: str) -> dict[str, Any]:
        """Return plain JSON values; `deviations` lists the differences from the published protocol of `suite`."""
        published = LiberoProtocol.of(suite)
        deviations = [
            f"{f.name}: {getattr(self, f.name)}, the protocol says {getattr(published, f.name)}"
            for f in fields(self)
            if getattr(self, f.name) != getattr(published, f.name)
        ]
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self) | {"deviations": deviations}))
        return plain
