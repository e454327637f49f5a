"""A tiny environment and policy that workers import by name, with faults on demand."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs import EvalEnv
from vlagents_ray.errors import ConnectionLost, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs

LINE = "eval_fakes:Line"
OTHER_LINE = "eval_fakes:OtherLine"
SPARING_LINE = "eval_fakes:SparingLine"
CLINGING = "eval_fakes:Clinging"
EVERY = -1  # `lost_on` for all seeds
HURRY = "VLAGENTS_RAY_TEST_HURRY"  # variable, see `Unhurried`
# Search path with which other processes import this module.
PYTHONPATH = f"{Path(__file__).parent}:{Path(__file__).parents[2]}"


class Line(EvalEnv):
    """A point on a line must reach 0 within 10 steps, which is impossible from far away.

    `trouble` maps a kind of fault to the seeds in whose fourth step it occurs, once for each seed:
    a file in `folder` marks it. Kinds: "raise", "exit", "hang" (sleep forever), "freeze" (sleep
    forever while holding the GIL), and "gate", which waits for the file `folder/open`.
    """

    max_steps = 10

    def __init__(
        self,
        folder: str | None = None,
        trouble: Mapping[str, list[int]] | None = None,
        camera: tuple[int, int] | None = None,
        state_dim: int = 1,
        broken: str | None = None,
    ) -> None:
        if broken is not None:
            raise RuntimeError(broken)
        self._folder = Path(folder) if folder is not None else None
        self._trouble = trouble or {}
        self._camera = camera
        self._state_dim = state_dim
        self._seed = 0
        self._steps = 0
        self._position = 0.0

    @property
    def contract(self) -> Contract:
        cameras = {"front": CameraSpec(*self._camera)} if self._camera else {}
        state = {"position": StateSpec(self._state_dim)}
        return Contract(cameras=cameras, state=state, action=ActionSpec(dim=1), control_hz=10.0)

    @property
    def instruction(self) -> str:
        return f"bring {self._position:.3f} to zero"

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self._seed, self._steps = seed, 0
        self._position = float(np.random.default_rng(seed).uniform(2.0, 12.0))
        return self._look(), {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        if self._steps == 4:
            for kind, seeds in self._trouble.items():
                if self._seed in seeds and self._first_time(kind):
                    self._misbehave(kind)
        self._position += float(np.clip(act.action[0], -1.0, 1.0))
        success = abs(self._position) < 0.5
        return (
            self._look(),
            -abs(self._position),
            False,
            self._steps == self.max_steps,
            {"success": success},
        )

    def describe(self) -> dict[str, Any]:
        return {"simulator": "line", "version": 1}

    def close(self) -> None:
        self._position = 0.0

    def _look(self) -> Obs:
        cameras = {}
        if self._camera:
            cameras["front"] = np.full(
                (*self._camera, 3), (20 * self._steps, 200 - 20 * self._steps, 60), np.uint8
            )
        state = np.full(self._state_dim, self._position, np.float32)
        return Obs(cameras=cameras, state={"position": state})

    def _first_time(self, kind: str) -> bool:
        if self._folder is None:
            return True
        mark = self._folder / f"{kind}-{self._seed}"
        if mark.exists():
            return False
        part = mark.with_suffix(".part")
        part.write_text(str(os.getpid()))
        part.rename(mark)
        return True

    def _misbehave(self, kind: str) -> None:
        print(f"misbehaving: {kind}", file=sys.stderr, flush=True)
        if kind == "raise":
            raise RuntimeError("the simulator exploded")
        if kind == "exit":
            os._exit(7)
        if kind == "hang":
            threading.Event().wait()
        if kind == "freeze":
            ctypes.PyDLL(None).pause()
        if kind == "gate" and self._folder is not None:
            wait_for((self._folder / "open").exists)


class SevenLine(Line):
    """An environment for policies with seven numbers in an action; it uses the first."""

    @property
    def contract(self) -> Contract:
        return replace(super().contract, action=ActionSpec(dim=7))


class Clinging(Line):
    """An environment whose `close` never returns."""

    def close(self) -> None:
        threading.Event().wait()


class OtherLine(Line):
    """The same environment under another name."""


class SparingLine(Line):
    """An environment that renders only observations that are used; `rendered` counts the images of
    all instances.
    """

    rendered = 0

    def _look(self) -> Obs:
        obs = super()._look()
        if self._steps and not self.looked_at:
            return replace(obs, cameras={})
        SparingLine.rendered += len(obs.cameras)
        return obs


class ToZero(Agent):
    """A policy that steps to zero with random noise, and returns `chunk` rows at a time."""

    def __init__(
        self, chunk: int = 1, state_dim: int | None = None, lost_on: int | None = None
    ) -> None:
        self._chunk = chunk
        self._state_dim = state_dim
        self._lost_on = lost_on  # the seed in whose calls the connection breaks
        self._seed = 0
        self._rng = np.random.default_rng(0)

    @property
    def contract(self) -> Contract | None:
        state = {"position": StateSpec(self._state_dim)} if self._state_dim is not None else None
        return Contract(state=state, action=ActionSpec(dim=1))

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._seed = kwargs["seed"]
        self._rng = np.random.default_rng(self._seed)
        return {}

    def act(self, obs: Obs) -> Act:
        if self._lost_on in (self._seed, EVERY):
            raise ConnectionLost("the server went away")
        noise = self._rng.normal(0.0, 0.1, (self._chunk, 1))
        return Act((-float(obs.state["position"][0]) + noise).astype(np.float32))


class Unhurried(ToZero):
    """A slow policy that returns chunks of one second for a robot at 50 Hz.

    Each call sleeps, so that an evaluation lasts until the file exists that the variable `HURRY`
    names.
    """

    def __init__(self, takes_s: float = 0.05) -> None:
        super().__init__(chunk=50, state_dim=1)
        self._takes_s = takes_s

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return super().reset(obs, instruction, **{"seed": 0} | kwargs)  # a real robot sends no seed

    def act(self, obs: Obs) -> Act:
        if not Path(os.environ.get(HURRY, "")).is_file():
            time.sleep(self._takes_s)
        return super().act(obs)


class Silent(ToZero):
    """A policy that never answers an `act`."""

    def act(self, obs: Obs) -> Act:
        threading.Event().wait()
        raise AssertionError


class Teller(ToZero):
    """A policy that fails with an error that contains the environment variables of its process."""

    def act(self, obs: Obs) -> Act:
        raise PolicyFailed(
            str(
                {
                    name: os.environ.get(name)
                    for name in ("OMP_NUM_THREADS", "LP_NUM_THREADS", "EXTRA")
                }
            )
        )


def wait_for(true: Any, timeout_s: float = 120.0, every_s: float = 0.02) -> None:
    """Poll until `true()` returns a true value; raise `TimeoutError` after `timeout_s`.

    A slow condition, such as whether a process has ended, is polled less often, to leave CPU time
    to the process.
    """
    deadline = (begun := time.monotonic()) + timeout_s
    while not true():
        if (now := time.monotonic()) > deadline:
            raise TimeoutError(f"waited {timeout_s:g} s for {true}")
        time.sleep(max(every_s, min(9 * (now - begun), 0.5)))
        begun = time.monotonic()


class Clock:
    """A clock that returns the time that a test set."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


class SimulatedTime:
    """A stand-in for the module `time` whose clock advances when a thread sleeps."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    perf_counter = monotonic

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 1e-4)
