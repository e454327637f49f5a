"""LIBERO's tasks: their names, files and initial states."""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.envs.libero import import_libero
from vlagents_ray.envs.libero.benchmark_protocol import SUITES
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
    """The task `name`, "SUITE/NUMBER" or "SUITE/NAME"; imports LIBERO. Raises `UnknownEnv`."""
    suite, which = require_suite(name)
    root = import_libero.load()
    known = list(require("libero.libero.benchmark").task_maps[suite].values())
    names = [task.name for task in known]
    if which.isdecimal() and int(which) < len(known):
        number = int(which)
    elif which in names:
        number = names.index(which)
    else:
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {len(known) - 1}, or a name such as {names[0]!r}"
        )
    found = known[number]
    return LiberoTask(
        suite=suite,
        number=number,
        name=found.name,
        language=found.language,
        problem=root / "bddl_files" / found.problem_folder / found.bddl_file,
        states=root / "init_files" / found.problem_folder / found.init_states_file,
    )


def read_states(path: Path) -> np.ndarray:
    """The initial states in a file of the package, (N, D) float64: time, qpos and qvel of MuJoCo.

    They are pickled numpy arrays. LIBERO loads them as any pickle; here nothing but such an array is let in.
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
