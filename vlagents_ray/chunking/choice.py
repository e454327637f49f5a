"""The choice of the mode in which a policy's chunks are executed.

`auto` is the default of `vlagents-ray robot`, of `run_loop`, and of the real-time clock of an
evaluation, so that an evaluation measures what a robot does. The choice is made once, at the
beginning of a run, from what is known of the policy; it does not change during the run.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

from vlagents_ray.abilities import BeginsWithPlan, HasSuccess, ability
from vlagents_ray.chunking.buffer import Mode
from vlagents_ray.chunking.player import PlayerSettings
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.interface import Agent, Obs
from vlagents_ray.success import SuccessCurve, curves_in

ChosenMode = Literal["auto", "open_loop", "ensemble", "async"]
"""A mode of the chunk player, or "auto", which `choose` replaces with one of them."""

WAIT_S = 1.0
"""The time, s, for which a robot's tick waits for an answer in the modes that wait: half of the
default of `--silent-s`, after which the watchdog stops the robot.
"""
# Tolerance in ticks: 1.1 s at 10 Hz are 11 ticks, although 1.1 * 10 > 11 in floating point.
_EXACTLY = 1e-9
# The number of answers of which the fastest one is the measured delay: a single answer may be late
# by accident, and the first one may include a cold start.
_PROBES = 3
# The settings of a player that change its success. A curve applies to a robot that has all of
# them.
_NOT_OF_SUCCESS = {"mode", "ensemble_m", "deadline_s", "timeout_s", "max_age_s", "safe"}
_DEFAULTS = {
    field.name: field.default
    for field in fields(PlayerSettings)
    if field.name not in _NOT_OF_SUCCESS
}


@dataclass(frozen=True, slots=True)
class Choice:
    """The mode in which a policy's chunks are executed."""

    settings: PlayerSettings
    line: str
    """The mode, the reason, and the measured success, for the operator."""

    @property
    def mode(self) -> Mode:
        """The mode of the chunk player."""
        return self.settings.mode


def choose(
    contract: Contract | None,
    *,
    mode: ChosenMode = "auto",
    longest_prefix: int = 0,
    curves: Iterable[SuccessCurve] = (),
    hz: float | None = None,
    delay_s: float | None = None,
    **settings: Any,
) -> Choice:
    """Choose the mode for a policy.

    With "auto", the mode is "async" if the policy declares whether its actions are relative, and
    otherwise "open_loop", since a late row is executed right only if its meaning is known. It is
    also "open_loop" if each answer has a single action, or if the delay of an answer is more than
    half of a chunk. "open_loop" executes half of a chunk, as its later rows are the least
    accurate ones. The leftover plan is sent (`real_time_chunking`) only if the checkpoint was
    measured with it, and solved more episodes at this delay.

    Args:
        contract: The policy's contract.
        mode: A mode, which is obeyed, or "auto".
        longest_prefix: The largest number of rows of the executed plan with which the policy's
            chunks begin (see `BeginsWithPlan`).
        curves: The measured success of the policy's checkpoint.
        hz: The rate of the control loop, 1/s.
        delay_s: The time from an observation to the arrival of its answer, s; None if it is
            unknown.
        settings: Further fields of `PlayerSettings`.

    Returns:
        The settings of the chunk player, and a line for the operator.

    Raises:
        ConfigError: `settings` contain `merge` or `real_time_chunking` without a mode "async".
    """
    if mode == "auto" and (settings.get("merge", "newest") != "newest" or _is_rtc(settings)):
        raise ConfigError(
            "merge and real_time_chunking: expected mode='async' with them, got mode='auto'"
        )
    curves = list(curves)
    delay = _Delay(hz, delay_s)
    chunk = _usable_rows(contract, settings)

    if mode != "auto":
        chosen, reason = _settings(mode, settings), "as set"
    else:
        why_waits = _why_waits(contract, chunk, delay)
        if why_waits is not None:
            half = None if chunk is None else max(1, chunk // 2)
            waiting = {**settings, "execute": settings.get("execute") or half}
            chosen, reason = _settings("open_loop", waiting), why_waits
        else:
            kind = "relative" if contract is not None and contract.action.relative else "absolute"
            chosen, reason = _settings("async", settings), f"the contract declares {kind} actions"
            with_prefixes = replace(chosen, real_time_chunking=True)
            if delay.rows is not None and 0 < delay.rows <= longest_prefix:
                better = _better(with_prefixes, chosen, curves, delay.rows)
                if better is not None:
                    chosen = better
                    reason += f", and its checkpoint solves more with prefixes at {delay}"

    if mode == "auto" and chosen.execute is None:
        # A robot that runs as the measured one did has its success.
        for curve in _matching(chosen, curves):
            chosen = replace(chosen, execute=_execute_of(curve))
            break
    matching = [curve for curve in curves if _applies(curve, chosen)]
    return Choice(chosen, f"{_named(chosen, chunk)}: {reason}; {_measured(matching, delay)}")


def choose_for(
    agent: Agent,
    *,
    mode: ChosenMode = "auto",
    hz: float | None = None,
    delay_s: float | None = None,
    **settings: Any,
) -> Choice:
    """Choose the mode for an agent, from what the agent or its server declares.

    Args:
        agent: The policy: a `RemoteAgent`, or an initialized agent of this process.
        mode: As in `choose`.
        hz: As in `choose`.
        delay_s: As in `choose`; `measured_delay` measures it.
        settings: Further fields of `PlayerSettings`.

    Returns:
        The settings of the chunk player, and a line for the operator.

    Raises:
        ConfigError: As in `choose`.
    """
    prefixes = ability(agent, BeginsWithPlan)
    success = ability(agent, HasSuccess)
    return choose(
        agent.contract,
        mode=mode,
        longest_prefix=0 if prefixes is None else prefixes.longest_prefix,
        curves=() if success is None else success.success_curves,
        hz=hz,
        delay_s=delay_s,
        **settings,
    )


def choose_from(metadata: Mapping[str, Any], **arguments: Any) -> Choice:
    """Choose the mode for a policy, from the metadata of its server.

    Args:
        metadata: The metadata, as in `RemoteAgent.metadata`.
        arguments: The other arguments of `choose`.

    Returns:
        The settings of the chunk player, and a line for the operator.

    Raises:
        ConfigError: As in `choose`.
        MalformedMessage: The metadata have values of a wrong type.
    """
    contract = metadata.get("contract")
    longest = metadata.get("longest_prefix")
    return choose(
        None if contract is None else Contract.from_json(contract),
        longest_prefix=longest if type(longest) is int else 0,
        curves=curves_in(metadata),
        **arguments,
    )


def measured_delay(agent: Agent, obs: Obs) -> float | None:
    """Return the time that an answer takes, s: the shortest of three.

    Args:
        agent: The policy, whose episode has begun with `obs`. Begin another one afterwards.
        obs: The observation of the requests.

    Returns:
        The time; None if the policy returned no action.
    """
    durations_s: list[float] = []
    with contextlib.suppress(VLAgentsError):  # the run will raise or count it
        for _ in range(_PROBES):
            begun = time.perf_counter()
            agent.act(obs)
            durations_s.append(time.perf_counter() - begun)
    return min(durations_s, default=None)


class _Delay:
    """The delay of an answer.

    Args:
        hz: The rate of the control loop, 1/s; None if it is unknown.
        seconds: The delay, s; None if it is unknown.
    """

    def __init__(self, hz: float | None, seconds: float | None) -> None:
        self.rows: int | None = None
        """The delay in rows, which are ticks; None if it is unknown."""
        self._ms = 0.0
        if hz is not None and seconds is not None:
            # An answer is executed from the next tick on.
            self.rows = math.ceil(seconds * hz - _EXACTLY)
            self._ms = seconds * 1e3

    def __str__(self) -> str:
        return f"{_rows(self.rows or 0)} of delay ({self._ms:.0f} ms)"


def _rows(count: int) -> str:
    return f"{count} row" if count == 1 else f"{count} rows"


def _is_rtc(settings: dict[str, Any]) -> bool:
    return bool(settings.get("real_time_chunking"))


def _settings(mode: Mode, settings: dict[str, Any]) -> PlayerSettings:
    """Return the settings of the player; a tick of a mode that waits has a time limit."""
    chosen = PlayerSettings(mode, **settings)
    return chosen if chosen.deadline_s is not None else replace(chosen, deadline_s=WAIT_S)


def _usable_rows(contract: Contract | None, settings: dict[str, Any]) -> int | None:
    """Return the number of rows of a chunk that may be executed; None if it is unknown."""
    chunk = None if contract is None else contract.chunk
    horizon = settings.get("horizon")
    known = [rows for rows in (chunk, horizon) if rows is not None]
    return min(known) if chunk is not None else None


def _why_waits(contract: Contract | None, chunk: int | None, delay: _Delay) -> str | None:
    """Return the reason why the robot must wait for each answer; None if it need not."""
    if contract is None or contract.action.relative is None:
        return (
            "the contract does not declare whether actions are relative or absolute (set `delta` "
            "of its `action`)"
        )
    if chunk == 1:
        # An answer to an earlier observation has no row left for this tick.
        return "each answer has a single action"
    if chunk is not None and delay.rows is not None and 2 * delay.rows > chunk:
        return f"{delay} is more than half of a chunk of {_rows(chunk)}"
    return None


def _applies(curve: SuccessCurve, settings: PlayerSettings) -> bool:
    """Return whether a curve was measured with these settings."""
    actual = {name: getattr(settings, name) for name in _DEFAULTS}
    return curve.mode == settings.mode and actual == {**_DEFAULTS, **curve.settings}


def _execute_of(curve: SuccessCurve) -> int | None:
    """Return the `execute` with which a curve was measured; the server's value is not trusted."""
    execute = curve.settings.get("execute")
    return execute if type(execute) is int and execute >= 1 else None


def _matching(settings: PlayerSettings, curves: Iterable[SuccessCurve]) -> Iterator[SuccessCurve]:
    """Yield the curves that were measured with these settings, with any `execute` if none is
    set.
    """
    for curve in curves:
        execute = settings.execute or _execute_of(curve)
        if _applies(curve, replace(settings, execute=execute)):
            yield curve


def _better(
    settings: PlayerSettings,
    other: PlayerSettings,
    curves: Sequence[SuccessCurve],
    rows: int,
) -> PlayerSettings | None:
    """Return the first settings, with the `execute` with which they were measured, if more episodes
    were solved with them at a delay than with the other ones, in each environment in which both
    were measured; otherwise None.
    """
    others: dict[str, list[float]] = {}
    for curve in _matching(other, curves):
        others.setdefault(curve.env, []).append(curve.floor(rows))

    compared = [curve for curve in _matching(settings, curves) if curve.env in others]
    if not compared or any(curve.floor(rows) <= max(others[curve.env]) for curve in compared):
        return None
    execute = settings.execute or _execute_of(compared[0])
    return replace(settings, execute=execute)


def _named(settings: PlayerSettings, chunk: int | None) -> str:
    """Return the mode and the settings that belong to it, in words."""
    words = f"mode {settings.mode}"
    if settings.mode == "open_loop":
        of_chunk = "" if chunk is None else f" of {chunk}"
        executed = "all" if settings.execute is None else f"{settings.execute}{of_chunk}"
        words += f", which executes {executed} rows and waits for the next answer"
    elif settings.real_time_chunking:
        words += " with prefixes"
    return words


def _measured(curves: Sequence[SuccessCurve], delay: _Delay) -> str:
    """Return the measured success in words."""
    if not curves:
        return "no measured success for this checkpoint in this mode"
    texts: list[str] = []
    for curve in curves:
        if delay.rows is None:
            rows = curve.tolerated
            text = f"at the tolerated delay of {_rows(rows)}"
        else:
            # The next longer delay that was measured, as success falls with the delay.
            longer = [rows for rows in curve.solved if rows >= delay.rows]
            if not longer:
                texts.append(f"{curve.env} not at {delay}, only up to {_rows(max(curve.solved))}")
                continue
            rows, text = longer[0], f"at {_rows(longer[0])}"
        solved = curve.solved[rows]
        rate = 100 * solved.solved / solved.episodes
        texts.append(f"{rate:.0f} % of {solved.episodes} {text}, {curve.env}")
    return f"measured: {'; '.join(texts)}"
