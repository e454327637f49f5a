"""LIBERO's tasks: their names, files and initial states; and those that vary them by other files alone.

Of LIBERO-PRO and LIBERO-Plus hf-libero can play some suites and tasks.
LIBERO-PRO (Zhou et al. 2025, arXiv 2510.03827) names its suites after LIBERO's: `libero_goal_swap` has other positions,
`_lan` other instructions, `_task` other goals, `_object` other objects. LIBERO-Plus (Fei et al. 2025, arXiv 2510.13626)
names its tasks after LIBERO's: `NAME_language_7` has another instruction, `NAME_level3_sample2` other positions.
"""

from __future__ import annotations

import codecs
import hashlib
import json
import os
import re
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vlagents_ray.envs.libero.package import import_libero
from vlagents_ray.envs.render_probe import failing
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require
from vlagents_ray.wire.pickles import read_pickled_array

VARIABLE = "LIBERO_FILES"
_PROBLEMS, _STATES = "bddl_files", "init_files"
_CURE = (
    f"download LIBERO-PRO's, hf download zhouxueyang/LIBERO-Pro --repo-type dataset --local-dir libero-pro, and set "
    f"{VARIABLE} to that folder on every node, or the env's option `files`"
)


@dataclass(frozen=True, slots=True)
class LiberoTask:
    """A task of a suite of LIBERO, or of one that varies it."""

    suite: str
    number: int  # in the suite, as openpi and OpenVLA count
    name: str  # LIBERO's, e.g. "pick_up_the_milk_and_place_it_in_the_basket"
    language: str  # the instruction that policies are given: LIBERO takes it from the name
    problem: Path  # its BDDL file
    states: Path  # its initial states
    varied: bool = False  # its files are not LIBERO's own

    @property
    def full_name(self) -> str:
        """The task's name in `Libero.tasks()`, e.g. "libero_object/7"; a variant in one of these goes by its name."""
        return f"{self.suite}/{self.name if self.passes_for_own else self.number}"

    @property
    def passes_for_own(self) -> bool:
        """Whether it is a variant in one of LIBERO's own suites, with whose tasks it must not be counted."""
        return self.varied and self.suite in SUITES


def task_names() -> list[str]:
    """Every task, e.g. "libero_spatial/0", those of the suites in `LIBERO_FILES` included; needs no simulator."""
    counts = {name: suite.tasks for name, suite in SUITES.items()} | _varied_suites()
    return [f"{suite}/{number}" for suite, count in counts.items() for number in range(count)]


def require_suite(name: str) -> tuple[str, str]:
    """Suite and task of "SUITE/NUMBER" or "SUITE/NAME"; `UnknownEnv` for an unknown suite, or too large a number."""
    suite, _, which = name.partition("/")
    if not base_of(suite):
        raise UnknownEnv(
            f"libero has no suite {suite!r}: want one of {sorted(SUITES)}, as in 'libero_spatial/0'"
            f"{did_you_mean(suite, SUITES)}"
        )
    if not which or (suite in SUITES and which.isdecimal() and int(which) >= SUITES[suite].tasks):
        count = f"0 to {SUITES[suite].tasks - 1}" if suite in SUITES else "a number"
        raise UnknownEnv(f"libero: {suite} has no task {which!r}: want {count}, or a name")
    return suite, which


def find_task(name: str, files: str | None = None) -> LiberoTask:
    """The task `name`, "SUITE/NUMBER" or "SUITE/NAME"; imports LIBERO.

    Args:
        name: The task. A suite that varies one of the five is looked for in the folder of variants, and so is a name
            in one of the five that LIBERO does not have.
        files: The folder of variants; None is what LIBERO_FILES names.

    Raises:
        UnknownEnv: There is no such task.
        ConfigError: The folder of variants is not given, or the task wants what hf-libero does not have.
    """
    suite, which = require_suite(name)
    root = import_libero()
    known = require("libero.libero.benchmark").task_maps[base_of(suite)]
    own = suite in SUITES and (which.isdecimal() or which in known or _files_folder(files) is None)
    place = root if own else _require_files_folder(files)
    names = list(known) if own else _varied_names(place, suite, list(known))
    if which.isdecimal() and int(which) < len(names):
        number = int(which)
    elif which in names:
        number = names.index(which)
    else:
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {len(names) - 1}, or a name such as {names[0]!r}"
        )
    if not own:
        return LiberoTask(suite, number, names[number], *_read_variant(place, suite, names[number]), varied=True)
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
    with zipfile.ZipFile(path) as archive:
        [pickled] = [archive.read(name) for name in archive.namelist() if name.endswith("/data.pkl")]
    if pickled.startswith(b"\x80\x04"):  # LIBERO-PRO's protocol, which torch's own safe reader does not know
        return np.atleast_2d(read_pickled_array(pickled))
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
    return np.atleast_2d(states)  # LIBERO-Plus writes a single one


def _files_folder(chosen: str | None = None) -> Path | None:
    """The folder of variants, `chosen` or the one that `LIBERO_FILES` names; None if neither is given."""
    named = chosen or os.environ.get(VARIABLE)
    return Path(named) if named else None


def _require_files_folder(chosen: str | None = None) -> Path:
    """The folder of variants; raises `ConfigError` if none is given, or it lacks a part."""
    found = _files_folder(chosen)
    if found is None:
        raise ConfigError(f"libero: suites that vary LIBERO's want their files; {_CURE}")
    lacks = [part for part in (_PROBLEMS, _STATES) if not (found / part).is_dir()]
    if lacks:
        raise ConfigError(f"libero: the folder of variants {found} lacks {lacks}; {_CURE}")
    return found


def _varied_suites() -> dict[str, int]:
    """The suites in the folder that `LIBERO_FILES` names, without LIBERO's own, and how many tasks each has."""
    found = _files_folder()
    here = sorted(found.glob(f"{_PROBLEMS}/*/")) if found else []
    named = {one.name: len(list(one.glob("*.bddl"))) for one in here if base_of(one.name)}
    return {suite: count for suite, count in named.items() if count and suite not in SUITES}


def _varied_names(place: Path, suite: str, known: list[str]) -> list[str]:
    """Return a suite's tasks, in LIBERO's order where they are LIBERO's, else by the alphabet; raises `UnknownEnv`."""
    here = {file.stem for file in place.glob(f"{_PROBLEMS}/{suite}/*.bddl")}
    if not here:
        have = sorted(one.name for one in place.glob(f"{_PROBLEMS}/*/"))
        raise UnknownEnv(f"libero: {place} has no suite {suite!r}: want one of {have}{did_you_mean(suite, have)}")
    return list(known) if here == set(known) else sorted(here)


def _read_variant(place: Path, suite: str, name: str) -> tuple[str, Path, Path]:
    """Return a task's instruction, its BDDL file and its initial states."""
    problem = place / _PROBLEMS / suite / f"{name}.bddl"
    _require_playable(problem)
    unspoken = re.sub(r"_language_\d+$", "", name)  # of the task whose instruction alone is another
    looked = [
        place / _STATES / part / f"{one}.pruned_init"
        for part, one in ((suite, name), (f"libero_newobj/{suite}", name), (suite, unspoken))
    ]
    states = next((file for file in looked if file.is_file()), None)
    if states is None:
        raise ConfigError(f"libero: {problem} has no initial states: looked for {[str(file) for file in looked]}")
    about = require("libero.libero.envs.bddl_utils").get_problem_info(str(problem))
    return about["language_instruction"], problem, states


def files_digest(problem: Path, states: Path) -> str:
    """Stands for the contents of a task's two files in the results."""
    return hashlib.sha256(problem.read_bytes() + states.read_bytes()).hexdigest()[:16]


def _require_playable(problem: Path) -> None:
    """Raise `ConfigError` unless hf-libero has the task's scene and all its objects."""
    envs, objects = require("libero.libero.envs"), require("libero.libero.envs.objects").OBJECTS_DICT
    with failing("libero", f"read {problem}"):
        parsed = require("libero.libero.envs.bddl_utils").robosuite_parse_problem(str(problem))
    placed = {one for one in parsed["fixtures"] if not one.endswith(("table", "floor"))}  # which belong to the scene
    lacks = sorted({*placed, *parsed["objects"]} - set(objects))
    if parsed["problem_name"] not in envs.TASK_MAPPING:
        lacks = [parsed["problem_name"], *lacks]
    if lacks:
        raise ConfigError(
            f"libero: {problem} wants {lacks}, which hf-libero does not have: such objects, tables and lights need the "
            f"code of LIBERO-PRO or LIBERO-Plus; choose a variant of positions, instructions or goals"
        )


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
        """Return the protocol of a suite, or of the one that it varies, with the changes that are not None."""
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
