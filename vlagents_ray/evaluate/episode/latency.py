"""Real-time evaluation: the environment's clock runs while the policy computes.

The clock is simulated, so the speed of the machine does not matter. An answer that took L seconds
arrives ceil(L * hz) ticks after its observation. During these ticks, the robot stands
("open_loop"), or executes the rest of the last chunk ("async"). Then it executes the answer's rows,
beginning with the same row as the chunk player (`vlagents_ray.chunking.buffer.ChunkBuffer`). A
synchronous evaluation is the case L = 0.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vlagents_ray.chunking.buffer import ChunkBuffer, DelayEstimate
from vlagents_ray.chunking.careful import CarefulRows
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.evaluate.plan.config import ClockConfig

_SYNCHRONOUS = ClockConfig(latency=0)
# Tolerance in ticks: 1.1 s at 10 Hz are 11 ticks, although 1.1 * 10 > 11 in floating point.
_EXACTLY = 1e-9


class Tick(NamedTuple):
    """One step of the environment."""

    action: np.ndarray  # (D,) float32
    waited: bool = False  # whether it is executed while waiting for an answer
    starved: bool = False  # whether the action is not a row of an answer, though one was due
    # Real-time mode: the time since the observation from which the action was computed, ms.
    age_ms: float | None = None
    # Whether the policy ends the episode after this tick, the last row of an answer with `done`.
    done: bool = False
    careful: bool = False  # whether the robot waits by choice before it moves a gripper


class ChunkExecutor:
    """Chooses the actions that are executed between two requests, in one episode."""

    def __init__(
        self,
        execute: int | None,
        clock: ClockConfig | None,
        env: Contract,
        last: np.ndarray | None = None,
    ) -> None:
        """Begin an episode, or a further task of it.

        Args:
            execute: Number of rows of a chunk to execute before the next request; None: all,
                or in "async" one, as in the chunk player.
            clock: The real-time mode, with a mode other than "auto"; None: the environment waits
                for the policy.
            env: The contract of the environment.
            last: The last action of the task before, (D,), whose targets are kept.

        Raises:
            ConfigError: The environment's rate, or the action that holds the robot before the first
                answer, is unknown; or the latter does not fit the environment's actions.
        """
        self._execute = execute
        self._real_time = clock is not None
        if clock is not None and clock.mode == "async":
            self._execute = execute or 1
        self._clock = _SYNCHRONOUS if clock is None else clock
        self._hz = env.control_hz or 0.0
        if self._real_time and not self._hz:
            raise ConfigError(
                "clock: expected an env whose contract declares control_hz, got none; declare the "
                "rate of its steps, in 1/s (env_options.control_hz of an environment of Gymnasium)"
            )

        self._spec = env.action
        latency = self._clock.latency
        latencies_s = latency if isinstance(latency, list) else [latency]
        self._latencies_s = itertools.cycle(latencies_s)
        if any(latencies_s) and last is None and self._clock.neutral is None:
            dim = env.action.dim
            if dim is None and not env.action.relative:
                raise _needs_neutral()
            if dim is not None:
                self._first_still(dim)

        if self._clock.neutral is not None:
            _require_fit(self._clock.neutral, env.action)

        self._plan = ChunkBuffer(action=env.action)
        self._careful = CarefulRows(self._plan, self._clock.fresh_grip)
        self._tick = 0  # the number of the next tick in real-time mode
        self._last = last  # the last action, (D,)
        self._delay = DelayEstimate()

    def latency_s(self, measured_s: float) -> float | None:
        """Return the latency of an answer that took `measured_s`, s; None if there is no clock."""
        if not self._real_time:
            return None
        latency_s = next(self._latencies_s)
        return measured_s if latency_s == "measured" else latency_s

    def request_info(self) -> dict[str, Any]:
        """Return the `Obs.info` for real-time chunking, with the remaining rows; {} if no rows
        remain or real-time chunking is off.
        """
        if not self._clock.real_time_chunking:
            return {}
        return self._plan.continuation(self._careful.rows_ahead(self._last, self._delay.ticks))

    def ticks(
        self,
        rows: np.ndarray,
        latency_s: float,
        info: Mapping[str, Any] | None = None,
        *,
        done: bool = False,
    ) -> Iterator[Tick]:
        """Return the ticks until the next request, given an answer with the rows `rows`, (H, D),
        the latency `latency_s` and the info `info`.

        If the answer has `done`, all its rows are executed, and the episode ends with the last one.
        If the answer is too late to execute any row, it does not end the episode.

        Raises:
            ConfigError: No row is left for real-time chunking.
        """
        execute = None if done else self._execute
        if not self._real_time:
            executed_rows = rows[:execute]
            for row in executed_rows[:-1]:
                yield Tick(row)
            yield Tick(executed_rows[-1], done=done)
            return
        if self._clock.real_time_chunking and not done and len(rows) <= (execute or len(rows)):
            raise ConfigError(
                f"clock.real_time_chunking: expected chunks that are longer than `execute`, got "
                f"{len(rows)} rows, all of which are executed before the next request; lower "
                f"`execute`, and do not set it in the policy"
            )

        # First, the ticks between the observation and the answer.
        ticks_waited = math.ceil(latency_s * self._hz - _EXACTLY)
        self._delay.add(ticks_waited)
        observed, origin = self._tick, self._plan.origin()
        executed_at_request = self._plan.executed
        yield from self._waiting(ticks_waited, rows.shape[1])
        if self._plan.outruns(executed_at_request, info or {}):
            return

        # The last row is always executed; otherwise no action of a policy that is slower than its
        # chunks would ever be executed.
        latest_start = self._plan.executed - len(rows) + 1
        start = max(executed_at_request, latest_start)
        awaited = self._careful.awaited(self._last, self._delay.ticks)
        self._plan.replace(rows, start, observed, origin, done=done)
        self._careful.answered(awaited)

        if self._clock.mode == "async" and execute is not None and ticks_waited >= execute:
            return  # The next request is due at this tick, as in the chunk player.

        end = len(rows) if execute is None else min(execute, len(rows))
        is_last = False
        while not is_last and not self._stands():
            step = self._plan.take()
            is_last = step.row >= end - 1
            yield self._executed(step.action, observed)._replace(done=done and is_last)

    def _stands(self) -> bool:
        """Return whether the robot waits for a new answer before it moves a gripper."""
        is_async = self._clock.mode == "async"
        return is_async and self._careful.stands(self._last, self._delay.ticks)

    def _waiting(self, ticks: int, dim: int) -> Iterator[Tick]:
        for _ in range(ticks):
            if self._stands():
                tick = self._executed(self._held(dim), None, waited=True)
                yield tick._replace(starved=False, careful=True)
                continue

            step = self._plan.next if self._clock.mode == "async" else None
            if step is None:
                action = self._held(dim)
                self._plan.move(action)
                yield self._executed(action, None, waited=True)
            else:
                self._plan.advance(step.action)
                yield self._executed(step.action, step.chunk.tick, waited=True)

    def _executed(self, action: np.ndarray, observed: int | None, *, waited: bool = False) -> Tick:
        """Return the next tick in real-time mode.

        Args:
            action: Its action, (D,).
            observed: The tick of the observation from which the action was computed; None for an
                action that is not a row of an answer.
            waited: Whether the executor waits for an answer at this tick.
        """
        age_ms = None if observed is None else 1e3 * (self._tick - observed) / self._hz
        self._tick += 1
        self._last = action
        self._careful.executed(action)
        return Tick(action, waited, observed is None, age_ms)

    def _held(self, dim: int) -> np.ndarray:
        """Return the action of a tick at which the robot stands, (D,)."""
        if self._last is not None:
            return Columns.from_spec(self._spec, dim).still(self._last)
        if self._clock.neutral is None:
            return self._first_still(dim)
        neutral = np.asarray(self._clock.neutral, np.float32)
        if neutral.shape != (dim,):
            raise ConfigError(
                f"clock.neutral: expected {dim} numbers, as the policy's actions have, got "
                f"{len(neutral)}"
            )
        return neutral

    def _first_still(self, dim: int) -> np.ndarray:
        """Return the action before the first answer, (D,): no motion, with open grippers, as
        environments begin their episodes.

        Raises:
            ConfigError: The contract does not declare the value of a target or an open gripper.
        """
        still = Columns.from_spec(self._spec, dim).first_still(1.0)
        if still is None:
            raise _needs_neutral()
        return still


def _needs_neutral() -> ConfigError:
    return ConfigError(
        "clock: expected clock.neutral, the action before the first answer, or an env whose "
        "contract declares relative actions and the value of an open gripper, got neither; give "
        "clock.neutral, as zeros might command a motion to a pose"
    )


def _require_fit(action: Sequence[float], spec: ActionSpec) -> None:
    """Raise `ConfigError` unless the environment's contract accepts `clock.neutral`."""
    expected = None
    if spec.dim is not None and len(action) != spec.dim:
        expected = f"{spec.dim} numbers, as the environment's actions have"
    elif spec.low is not None and min(action, default=0.0) < spec.low:
        expected = f"numbers of at least {spec.low:g}"
    elif spec.high is not None and max(action, default=0.0) > spec.high:
        expected = f"numbers of at most {spec.high:g}"
    elif spec.dim is not None:
        try:
            Columns.from_spec(spec, spec.dim).require_rotations(action)
        except InvalidAction:
            expected = f"a rotation ({spec.rotation}) in its columns"
    if expected is not None:
        raise ConfigError(f"clock.neutral: expected {expected}, got {list(action)}; correct it")
