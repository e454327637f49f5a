"""LIBERO's tasks: their names, files and initial states, and the protocol of an episode."""

from __future__ import annotations

import codecs
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.envs.libero.package import import_libero
from vlagents_ray.errors import UnknownEnv
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require


@dataclass(frozen=True, slots=True)
class LiberoTask:
    """A task of a suite of LIBERO."""

    suite: str
    number: int  # in the suite, as openpi and OpenVLA count
    name: str  # LIBERO's, e.g. "pick_up_the_milk_and_place_it_in_the_basket"
    language: str  # the instruction that policies are given: LIBERO takes it from the name
    problem: Path  # its BDDL file
    states: Path  # its initial states

    @property
    def full_name(self) -> str:
        """The task's name in `Libero.tasks()`, e.g. "libero_object/7"."""
        return f"{self.suite}/{self.number}"


def task_names() -> list[str]:
    """Every task, e.g. "libero_spatial/0"; needs no simulator."""
    return [f"{name}/{number}" for name, suite in SUITES.items() for number in range(suite.tasks)]


def require_suite(name: str) -> tuple[str, str]:
    """Suite and task of "SUITE/NUMBER" or "SUITE/NAME"; `UnknownEnv` for an unknown suite, or too large a number."""
    suite, _, which = name.partition("/")
    if suite not in SUITES:
        raise UnknownEnv(
            f"libero has no suite {suite!r}: want one of {sorted(SUITES)}, as in 'libero_spatial/0'"
            f"{did_you_mean(suite, SUITES)}"
        )
    if not which or (which.isdecimal() and int(which) >= SUITES[suite].tasks):
        raise UnknownEnv(f"libero: {suite} has no task {which!r}: want 0 to {SUITES[suite].tasks - 1}, or a name")
    return suite, which


def find_task(name: str) -> LiberoTask:
    """The task `name`, "SUITE/NUMBER" or "SUITE/NAME"; imports LIBERO; raises `UnknownEnv` if there is none."""
    suite, which = require_suite(name)
    root = import_libero()
    known = require("libero.libero.benchmark").task_maps[suite]
    names = list(known)
    if not which.isdecimal() and which not in names:
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {len(names) - 1}, or a name such as {names[0]!r}"
        )
    number = int(which) if which.isdecimal() else names.index(which)
    found = known[names[number]]
    return LiberoTask(
        suite=suite,
        number=number,
        name=found.name,
        language=found.language,
        problem=root / "bddl_files" / found.problem_folder / found.bddl_file,
        states=root / "init_files" / found.problem_folder / found.init_states_file,
    )


def read_states(path: Path) -> np.ndarray:
    """The initial states in a file, (N, D) float64: time, qpos and qvel of MuJoCo.

    They are pickled numpy arrays, in torch's archives. LIBERO loads them as any pickle; here nothing but such an array
    is let in.
    """
    torch = require("torch")
    numpys: list[Any] = [
        (np.empty(0).__reduce__()[0], "numpy.core.multiarray._reconstruct"),  # where numpy 1 had it, and wrote it down
        (codecs.encode, "_codecs.encode"),
        np.ndarray,
        np.dtype,
        type(np.dtype(np.float64)),
    ]
    with torch.serialization.safe_globals(numpys):
        states: np.ndarray = torch.load(path, weights_only=True)
    return states


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
        """Return the protocol of a suite with the changes that are not None."""
        changed = {name: value for name, value in changes.items() if value is not None}
        return cls(**{"max_steps": SUITES[suite].max_steps} | changed)

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
