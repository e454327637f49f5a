"""LIBERO's tasks: their names, files and initial states."""

from __future__ import annotations

import codecs
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.envs.libero import import_libero, variants
from vlagents_ray.envs.libero.benchmark_protocol import SUITES, base_of
from vlagents_ray.errors import UnknownEnv
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import require
from vlagents_ray.wire.pickles import read_pickled_array


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
    counts = {name: suite.tasks for name, suite in SUITES.items()} | variants.suites()
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
    root = import_libero.load()
    known = require("libero.libero.benchmark").task_maps[base_of(suite)]
    own = suite in SUITES and (which.isdecimal() or which in known or variants.folder(files) is None)
    place = root if own else variants.require_folder(files)
    names = list(known) if own else variants.names(place, suite, list(known))
    if which.isdecimal() and int(which) < len(names):
        number = int(which)
    elif which in names:
        number = names.index(which)
    else:
        raise UnknownEnv(
            f"libero: {suite} has no task {which!r}: want 0 to {len(names) - 1}, or a name such as {names[0]!r}"
        )
    if not own:
        return LiberoTask(suite, number, names[number], *variants.read(place, suite, names[number]), varied=True)
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
