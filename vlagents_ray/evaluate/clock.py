"""Real-time evaluation: the env's clock runs on while the policy thinks. Simulated, so no machine has to keep up.

An answer that took L seconds comes ceil(L * hz) ticks after its observation; the env is stepped through these with
what `ClockConfig.meanwhile` says, and then with the answer's rows. A synchronous evaluation is the case L = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.client.safe import SafeAction
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.evaluate.config import ClockConfig
from vlagents_ray.interface import DELAY, LEFTOVER, Obs

_EXACTLY = 1e-9  # ticks: 1.1 s at 10 Hz are 11 of them, though 1.1 * 10 > 11 in floating point


@dataclass(frozen=True, slots=True)
class Tick:
    """One step of the env."""

    action: np.ndarray  # (D,) float32
    waited: bool = False  # for an answer
    held: bool = False  # no row of any chunk is left for it


class Player:
    """What is executed from one question to the next, for the length of one episode."""

    def __init__(self, execute: int | None, clock: ClockConfig | None, env: Contract) -> None:
        """`execute`: rows of a chunk before the policy is asked again; None = all.

        `ConfigError` if nothing says how fast the clock runs, or what keeps the robot still before the first answer.
        """
        self._execute = execute
        self._clock = clock
        self._spec = env.action
        self._hz = 0.0 if clock is None else _rate(clock, env)
        if clock is not None:
            _require_still(clock, env.action)
        self._rest = np.empty((0, 0), np.float32)  # rows of the last chunk that nobody has executed
        self._last: np.ndarray | None = None  # (D,) action
        self._longest = 0  # ticks that an answer took

    def latency_s(self, measured_s: float) -> float:
        """What an answer that took `measured_s` counts as."""
        if self._clock is None:
            return 0.0
        return measured_s if self._clock.latency == "measured" else self._clock.latency

    def told(self) -> dict[str, Any]:
        """What an observation tells a policy that chunks in real time; nothing if no row is left to go on from."""
        if self._clock is None or not self._clock.real_time_chunking or not len(self._rest):
            return {}
        return {LEFTOVER: self._rest, DELAY: self._longest}

    def ticks(self, rows: np.ndarray, latency_s: float) -> Iterator[Tick]:
        """The steps until the policy is asked again, where its answer is `rows`, (H, D), and took so long."""
        wait = math.ceil(latency_s * self._hz - _EXACTLY)
        self._longest = max(self._longest, wait)
        for tick in self._waiting(wait, rows.shape[1]):
            self._last = tick.action
            yield tick
        # Row r is for r ticks after the observation. The last one is taken however late it comes: a single
        # action has no other, and a policy slower than its chunks are long would else never act.
        first = min(wait, len(rows) - 1) if self._clock is not None and self._clock.align else 0
        end = len(rows) if self._execute is None else max(first + 1, self._execute)
        self._rest = rows[end:]
        for row in rows[first:end]:
            self._last = row
            yield Tick(row)

    def _waiting(self, ticks: int, dim: int) -> Iterator[Tick]:
        if not ticks or self._clock is None:
            return
        left = self._rest[:ticks] if self._clock.meanwhile == "chunk" else self._rest[:0]
        for row in left:
            yield Tick(row, waited=True)
        held = self._held(self._clock, dim)
        for _ in range(ticks - len(left)):
            yield Tick(held, waited=True, held=True)

    def _held(self, clock: ClockConfig, dim: int) -> np.ndarray:
        """What is executed where no row is left, (D,)."""
        start = neutral(self._spec, dim) if clock.neutral is None else np.asarray(clock.neutral, np.float32)
        if start.shape != (dim,):
            raise ConfigError(f"clock.neutral: got {len(start)} numbers, the policy's actions have {dim}")
        if self._last is None:
            return start
        if clock.meanwhile == "hold" or (clock.meanwhile == "chunk" and not _relative(self._spec)):
            return self._last
        return start if clock.neutral is not None else SafeAction("zero", self._spec)(Obs(), self._last)


def neutral(spec: ActionSpec, dim: int | None = None) -> np.ndarray:
    """No motion, (D,) float32, and an open gripper where `spec` says how one is opened; for relative actions."""
    dim = spec.dim if dim is None else dim
    if dim is None:
        raise InvalidAction("neutral action: got a contract without action.dim; want one that states it")
    action = np.zeros(dim, np.float32)
    if spec.gripper_open is not None:
        action[-1] = spec.gripper_open
    return action


def _rate(clock: ClockConfig, env: Contract) -> float:
    hz = clock.hz or env.control_hz
    if not hz:
        raise ConfigError("clock: got no hz, and the env's contract states no control_hz; give clock.hz, in 1/s")
    return hz


def _relative(spec: ActionSpec) -> bool:
    return bool(spec.delta) or "velocity" in (spec.space or "")


def _require_still(clock: ClockConfig, spec: ActionSpec) -> None:
    if clock.latency != 0 and clock.neutral is None and not _relative(spec):
        raise ConfigError(
            "clock: the env's contract does not say that its actions are relative, so that zeros may be a pose to go "
            "to; give clock.neutral, the action that is executed before the first answer comes"
        )
