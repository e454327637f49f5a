"""What varies LIBERO by other files alone: suites and tasks of LIBERO-PRO and LIBERO-Plus that hf-libero can play.

LIBERO-PRO (Zhou et al. 2025, arXiv 2510.03827) names its suites after LIBERO's: `libero_goal_swap` has other positions,
`_lan` other instructions, `_task` other goals, `_object` other objects. LIBERO-Plus (Fei et al. 2025, arXiv 2510.13626)
names its tasks after LIBERO's: `NAME_language_7` has another instruction, `NAME_level3_sample2` other positions.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from vlagents_ray.envs.libero.benchmark_protocol import SUITES, base_of
from vlagents_ray.envs.rendering.render_probe import failing
from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require

VARIABLE = "LIBERO_FILES"
_PROBLEMS, _STATES = "bddl_files", "init_files"
_CURE = (
    f"download LIBERO-PRO's, hf download zhouxueyang/LIBERO-Pro --repo-type dataset --local-dir libero-pro, and set "
    f"{VARIABLE} to that folder on every node, or the env's option `files`"
)


def folder(chosen: str | None = None) -> Path | None:
    """The folder of variants, `chosen` or the one that `LIBERO_FILES` names; None if neither is given."""
    named = chosen or os.environ.get(VARIABLE)
    return Path(named) if named else None


def require_folder(chosen: str | None = None) -> Path:
    """The folder of variants; raises `ConfigError` if none is given, or it lacks a part."""
    found = folder(chosen)
    if found is None:
        raise ConfigError(f"libero: suites that vary LIBERO's want their files; {_CURE}")
    lacks = [part for part in (_PROBLEMS, _STATES) if not (found / part).is_dir()]
    if lacks:
        raise ConfigError(f"libero: the folder of variants {found} lacks {lacks}; {_CURE}")
    return found


def suites() -> dict[str, int]:
    """The suites in the folder that `LIBERO_FILES` names, without LIBERO's own, and how many tasks each has."""
    found = folder()
    here = sorted(found.glob(f"{_PROBLEMS}/*/")) if found else []
    named = {one.name: len(list(one.glob("*.bddl"))) for one in here if base_of(one.name)}
    return {suite: count for suite, count in named.items() if count and suite not in SUITES}


def names(place: Path, suite: str, known: list[str]) -> list[str]:
    """The names of a suite's tasks: in LIBERO's order where they are LIBERO's, and else by the alphabet.

    Args:
        place: The folder of variants.
        suite: The suite.
        known: The tasks of the suite that it varies, in LIBERO's order.

    Raises:
        UnknownEnv: The folder has no such suite.
    """
    here = {file.stem for file in place.glob(f"{_PROBLEMS}/{suite}/*.bddl")}
    if not here:
        have = sorted(one.name for one in place.glob(f"{_PROBLEMS}/*/"))
        raise UnknownEnv(f"libero: {place} has no suite {suite!r}: want one of {have}{did_you_mean(suite, have)}")
    return list(known) if here == set(known) else sorted(here)


def read(place: Path, suite: str, name: str) -> tuple[str, Path, Path]:
    """A task's instruction, as its BDDL file gives it, that file, and the one of its initial states; imports LIBERO.

    Raises:
        ConfigError: The task wants an object or a scene that hf-libero does not have, or has no initial states.
        EnvFailed: hf-libero cannot read the BDDL file.
    """
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


def digest(problem: Path, states: Path) -> str:
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
