"""The tabletop that notes when its episodes began and ended: every evaluation that is measured plays it.

Standard library, numpy and this package's light part only: the peers' Python imports it too.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.interface import Act, Obs

NOTED = "vlagents_ray.bench.noted:Noted"  # its name for `make_env`


class Note(NamedTuple):
    """One episode that was played to its end."""

    begun: float  # s of time.time(), before its reset
    ended: float  # after its last step
    steps: int
    seed: int


class Noted(Tabletop):
    """The tabletop with a line of notes for each finished episode, in a file for each process.

    `notes` is the folder; `step_ms` is CPU time that each step takes more, for a simulator's physics.
    """

    def __init__(self, *, notes: str, size: int = 224, max_steps: int = 80, step_ms: float = 0.0) -> None:
        super().__init__(width=size, height=size, max_steps=max_steps)
        self._notes = Path(notes)
        self._step_s = step_ms / 1e3
        self._begun = 0.0
        self._seed = 0

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        self._begun, self._seed = time.time(), seed
        return super().reset(seed=seed, options=options)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        until = time.thread_time() + self._step_s  # CPU time: the clock would run on while others have the core
        found = super().step(act)
        while self._step_s and time.thread_time() < until:
            pass
        if found[3]:  # truncated: nothing else ends it
            with (self._notes / f"{os.getpid()}.txt").open("a") as file:
                file.write(f"{self._begun!r} {time.time()!r} {self._steps} {self._seed}\n")
        return found


def read_notes(folder: Path) -> dict[int, list[Note]]:
    """What each process, by its id, has played, in order. A line that is being written is left out."""
    found = {}
    for file in folder.glob("*.txt"):
        lines = [line.split() for line in file.read_text().splitlines(keepends=True) if line.endswith("\n")]
        found[int(file.stem)] = [Note(float(a), float(b), int(steps), int(seed)) for a, b, steps, seed in lines]
    return found
