"""The environment of the evaluations that are measured: a wrapper of any environment, which records
its times.

This module imports only the standard library, numpy and this package's light part, since it is also
imported in the other systems' Python.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv, known_contract, make_env
from vlagents_ray.envs.graphics import Renderer
from vlagents_ray.interface import Act, Obs

TIMED_ENV = "benchmarks.environments:TimedEnv"  # name of the environment for `make_env`


class EpisodeTimes(NamedTuple):
    """The beginning and the end of an episode that was run to its end."""

    begun: float  # time before the reset, s of time.time()
    ended: float  # time after the last step, s of time.time()
    steps: int
    seed: int


class TimedEnv(EvalEnv):
    """Any environment, with a record of the beginning and end of each episode in one file per
    process.

    The episode with seed `seed` begins in initial state `seed` modulo the number of initial states.
    """

    def __init__(
        self,
        *,
        notes: str,
        env: str = "tabletop",
        size: int = 224,
        max_steps: int = 80,
        step_ms: float = 0.0,
    ) -> None:
        """Make the environment.

        Args:
            notes: The folder of the files with the records.
            env: The name of the environment.
            size: Width and height of the images, pixels.
            max_steps: The step limit.
            step_ms: Additional CPU time of each step, in place of a simulator's physics.
        """
        self._env = make_env(env, width=size, height=size, max_steps=max_steps)
        self.max_steps, self.init_states = self._env.max_steps, self._env.init_states
        self._notes = Path(notes)
        self._step_s = step_ms / 1e3
        self._begun = 0.0
        self._seed = self._steps = 0

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract | None:
        return known_contract(
            arguments["env"], dict.fromkeys(("width", "height"), arguments["size"])
        )

    @property
    def contract(self) -> Contract:
        return self._env.contract

    @property
    def instruction(self) -> str:
        return self._env.instruction

    def renderer(self) -> Renderer | None:
        return self._env.renderer()

    def describe(self) -> dict[str, Any]:
        return self._env.describe()

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self._begun, self._seed, self._steps = time.time(), seed, 0
        if options is None and self.init_states:
            options = {"init_state": seed % self.init_states}
        return self._env.reset(seed=seed, options=options)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        # The loop uses CPU time, since wall time would also pass while other processes have the
        # core.
        until = time.thread_time() + self._step_s
        self._env.looked_at = self.looked_at
        found = self._env.step(act)
        while self._step_s and time.thread_time() < until:
            pass
        self._steps += 1
        if found[3]:  # truncate the episode: nothing else ends it
            with (self._notes / f"{os.getpid()}.txt").open("a") as file:
                file.write(f"{self._begun!r} {time.time()!r} {self._steps} {self._seed}\n")
        return found

    def close(self) -> None:
        self._env.close()


def read_episode_times(folder: Path) -> dict[int, list[EpisodeTimes]]:
    """Return the episodes of each process in order, by process id. A line that is being written is
    ignored.
    """
    found = {}
    for file in folder.glob("*.txt"):
        lines = [
            line.split()
            for line in file.read_text().splitlines(keepends=True)
            if line.endswith("\n")
        ]
        found[int(file.stem)] = [
            EpisodeTimes(float(a), float(b), int(steps), int(seed)) for a, b, steps, seed in lines
        ]
    return found
