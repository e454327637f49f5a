"""Reproduction of a bundle: its recorded actions are executed here, and the success rates are
computed from these episodes alone.

No other part of a bundle is evidence: its author can write every column and every digest.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import re
import secrets
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any

from vlagents_ray.envs.base import BatchEnv, make_batch
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts import storage
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.episode.failures import env_side
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import files_of_env
from vlagents_ray.evaluate.replay import DRIFT
from vlagents_ray.evaluate.report.page import FILE as REPORT
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.changes import Change, program_changes
from vlagents_ray.evaluate.results.database import FILE as DATABASE
from vlagents_ray.evaluate.results.reader import CaseResults, Episode, Results, by_timing
from vlagents_ray.evaluate.results.statistics import Rate
from vlagents_ray.evaluate.results.summary import (
    TOTAL,
    Group,
    group_of,
    summarize,
    write_summary,
)
from vlagents_ray.policies.base.program import Program, software
from vlagents_ray.registry import env_suite, env_task, names
from vlagents_ray_results.bundle import MOST_BYTES, require_file, unpack
from vlagents_ray_results.recorded_actions import execute_actions

_LENGTH = 200  # maximum number of characters of a foreign text in a reason


@dataclass(frozen=True, slots=True)
class EpisodeVerification:
    """An episode whose recorded actions were to be executed here."""

    policy: str  # policy id
    task: str  # suite and env
    episode: int
    seed: int
    is_reproduced: bool
    reason: str | None  # why it is not reproduced: the outcomes there and here, or an error


@dataclass(frozen=True, slots=True)
class ReproducedRate:
    """The success rate of the reproduced episodes of a policy in an env, or in all envs."""

    policy: str  # policy id
    env: str
    tried: int  # number of episodes whose actions were to be executed
    success_once: Rate  # of the reproduced episodes alone
    # The rates if all other episodes had failed, and if all had succeeded; None if there are none.
    with_others: tuple[float, float] | None

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        rate = self.success_once.to_json()
        return {
            "policy": self.policy,
            "env": self.env,
            "tried": self.tried,
            "success_once": rate,
            "with_others": self.with_others,
        }


@dataclass(frozen=True, slots=True)
class Verification:
    """The reproduction of a bundle."""

    digest: str  # SHA-256 of the bundle's manifest, which identifies its content
    seed: int  # seed with which the episodes were drawn
    counted: int  # number of episodes that the rates of the bundle include
    episodes: tuple[EpisodeVerification, ...]
    rates: tuple[ReproducedRate, ...]
    # Versions of software and files of environments that differ from those here: "was" there, "is"
    # here.
    differences: tuple[Change, ...]
    # Changes between the episodes, which the author accepted; a rate describes several programs.
    accepted_changes: tuple[Change, ...]
    has_clock: bool  # whether some of the episodes were run in real-time mode

    @property
    def reproduced(self) -> int:
        """The number of reproduced episodes."""
        return sum(episode.is_reproduced for episode in self.episodes)

    @property
    def is_complete(self) -> bool:
        """Whether there are episodes, and all of them were reproduced."""
        return 0 < self.reproduced == len(self.episodes)

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON, with `reproduced` and `tried`."""
        return {
            "digest": self.digest,
            "seed": self.seed,
            "counted": self.counted,
            "tried": len(self.episodes),
            "reproduced": self.reproduced,
            "rates": [rate.to_json() for rate in self.rates],
            "episodes": [asdict(episode) for episode in self.episodes],
            "differences": [asdict(change) for change in self.differences],
            "accepted_changes": [asdict(change) for change in self.accepted_changes],
            "has_clock": self.has_clock,
        }


def verify(
    bundle: Path,
    *,
    into: Path | None = None,
    replay: int | None = None,
    seed: int | None = None,
    trust: bool = False,
    most_bytes: int = MOST_BYTES,
) -> Verification:
    """Reproduce the episodes of a bundle, which may come from a stranger.

    An episode is reproduced if its recorded actions can be executed here, and instruction, ending,
    number of steps, successes and return are the recorded ones (the return up to 1 %, because
    rounding differs between machines). This shows that these actions solve these tasks. It does not
    show that the policy chose them, in time, or that the bundle contains all episodes that its
    author ran.

    Nothing in the bundle is run, imported or unpickled. Its environments are only created if they
    are registered here and their options are numbers and words, unless `trust` is set.

    Args:
        bundle: The file of the bundle.
        into: A new folder for the bundle's results, which can be read, merged and exported like any
            others; None removes the results. The folder's summary and report are written from the
            database.
        replay: The number of episodes to execute, which are drawn from all that the rates include;
            None: all.
        seed: The seed with which these episodes are drawn; None selects a new seed, which the
            author of the bundle cannot know.
        trust: Whether the bundle's environments may name any code and files.
        most_bytes: The maximum size of all files of the bundle, bytes.

    Returns:
        The reproduced episodes and their rates.

    Raises:
        ConfigError: The file is not a bundle, is damaged or is larger than allowed, its database
            cannot be read, or `into` exists.
        StorageFailed: The disk is full, or cannot be written to.
    """
    if into is not None and into.exists():
        raise ConfigError(f"{into}: expected a new folder, got one that exists; choose another")
    require_file(bundle)
    if seed is None:
        seed = secrets.randbits(32)

    parent = None if into is None else into.absolute().parent
    with storage.storing(parent or Path(tempfile.gettempdir())):
        if parent is not None:
            parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="bundle.part-", dir=parent) as temporary:
            # The report contains the folder's name.
            folder = Path(temporary) / (into or bundle).name
            folder.mkdir()
            digest = unpack(bundle, folder, most_bytes=most_bytes)
            try:
                verification = _reproduce(folder, digest, replay, seed, trust=trust)
            except (VLAgentsError, sqlite3.Error):
                raise
            except (
                ArithmeticError,
                LookupError,
                RecursionError,
                TypeError,
                ValueError,
                AttributeError,
            ) as error:
                raise ConfigError(
                    f"{bundle}: its database holds values that no evaluation writes "
                    f"({type(error).__name__}: {error}); do not trust its author"
                ) from error

            if into is not None:
                os.replace(folder, into)
    return verification


def _reproduce(
    folder: Path, digest: str, replay: int | None, seed: int, *, trust: bool
) -> Verification:
    """Execute the actions of the drawn episodes; also write summary and report."""
    if not (folder / DATABASE).is_file():
        raise ConfigError(
            f"expected a bundle that `vlagents-ray bundle` wrote, got one without {DATABASE}"
        )
    results = Results.load(folder)
    if not results.runs or not results.cases:
        raise ConfigError(f"{DATABASE}: expected the results of an evaluation, got none")
    _require_distinct(results)
    write_summary(summarize(results))
    write_report(results, folder / REPORT)

    episodes: list[EpisodeVerification] = []
    executed_cases: list[CaseResults] = []
    for case, drawn in zip(results.cases, _drawn(results, replay, seed), strict=True):
        executed: list[Episode] = []
        for episode, here, reason in _executed(results, case, drawn, trust=trust):
            key = episode.result.key
            episodes.append(
                EpisodeVerification(
                    case.policy_id, case.task, key.episode, key.seed, reason is None, reason
                )
            )
            # The rates treat an episode that is not reproduced like one without a result.
            is_reproduced = here is not None and reason is None
            result = here if is_reproduced and here else EpisodeResult(key, "infra_failed")
            executed.append(replace(episode, result=result))
        if drawn:
            executed_cases.append(
                replace(case, planned=len(drawn), episodes=tuple(executed), attempts=())
            )

    differences: dict[Change, None] = {}
    for case in results.cases:
        differences |= dict.fromkeys(_differences(case, trust=trust))
    return Verification(
        digest,
        seed,
        len(results.counted),
        tuple(episodes),
        tuple(_rates(results.among(executed_cases))),
        tuple(differences),
        tuple(results.accepted_changes),
        any(case.settings.get("clock") is not None for case in executed_cases),
    )


def _require_distinct(results: Results) -> None:
    """Raise `ConfigError` if the database has an episode several times, which would count it
    several times.
    """
    known = set()
    for case in results.cases:
        for episode in case.counted_episodes:
            key = episode.result.key
            name = (case.policy_id, case.task, key.episode, key.seed)
            if name in known:
                raise ConfigError(
                    f"{DATABASE}: has the episode {key.episode} with the seed {key.seed} of "
                    f"{case.policy_id} in {case.task} twice, which no evaluation writes; do not "
                    "trust its author"
                )
            known.add(name)


def _drawn(results: Results, number: int | None, seed: int) -> list[list[Episode]]:
    """Return the drawn episodes of each case, in their order.

    The number of episodes is equal for all cases that have as many, so that each case is tried.
    """
    by_case = [list(case.counted_episodes) for case in results.cases]
    if number is None:
        return by_case

    draw = random.Random(seed)
    shuffled = []
    for index, episodes in enumerate(by_case):
        draw.shuffle(episodes)
        shuffled.append([(index, episode) for episode in episodes])
    draw.shuffle(shuffled)

    in_turn = (pair for pair in chain.from_iterable(zip_longest(*shuffled)) if pair is not None)
    drawn: list[list[Episode]] = [[] for _ in by_case]
    for index, episode in islice(in_turn, number):
        drawn[index].append(episode)
    return drawn


def _executed(
    results: Results, case: CaseResults, episodes: Iterable[Episode], *, trust: bool
) -> Iterator[tuple[Episode, EpisodeResult | None, str | None]]:
    """Execute the actions of these episodes, one after the other in one environment.

    Yields:
        The episode, its result here (None if there is none), and the reason why it is not
        reproduced (None if it is).
    """
    env: BatchEnv | None = None
    try:
        for episode in episodes:
            try:
                actions = _recorded_actions(results, episode)
            except ConfigError as error:
                yield episode, None, _cut(str(error))
                continue
            try:
                env = env or _make(case, trust=trust)
            except VLAgentsError as error:
                yield episode, None, f"could not be executed: {_cut(str(error))}"
                continue
            try:
                here = execute_actions(
                    env,
                    episode.result.key,
                    actions,
                    reset_options=case.settings.get("reset_options"),
                )
            except VLAgentsError as error:
                yield episode, None, f"{_in_words(episode.result)} there, here: {_cut(str(error))}"
                _close(env)  # a simulator that failed may be broken
                env = None
                continue
            yield episode, here, _difference(episode.result, here, len(actions))
    finally:
        if env is not None:
            _close(env)


def _recorded_actions(results: Results, episode: Episode) -> Sequence[Any]:
    """Return the recorded actions of an episode, (D,) each.

    Raises:
        ConfigError: There are none, or they cannot be read, or they cannot have the episode's
            outcome.
    """
    result = episode.result
    if result.status != "done":
        raise ConfigError(f"{_in_words(result)} there, which actions cannot reproduce")
    if episode.trajectory is None:
        raise ConfigError("no actions were recorded (eval --record all)")
    actions = Trajectory.load(results.file(episode.trajectory)).actions
    if not len(actions):
        raise ConfigError("its recording has no actions")
    return list(actions)


def _make(case: CaseResults, *, trust: bool) -> BatchEnv:
    """Create the environment of a case.

    Raises:
        ConfigError: The case is on a robot, or its environment is not registered here, or its
            options could name files or code and `trust` is off. Other errors of `make_batch` are
            also raised.
    """
    if case.settings.get("robot") is not None:
        raise ConfigError("it was run on a real robot")
    if not trust:
        require_harmless(case)
    with env_side("make"):
        return make_batch(case.env, 1, **(case.settings.get("env_options") or {}))


def _close(env: BatchEnv) -> None:
    with contextlib.suppress(VLAgentsError), env_side("close"):
        env.close()


def _difference(there: EpisodeResult, here: EpisodeResult, recorded: int) -> str | None:
    """Return the outcomes of an episode there and here; None if they are equal, and all `recorded`
    actions were executed.
    """
    if here.status != "done":
        return f"{_in_words(there)} there, here: {_cut(str(here.error))}"
    for name in ("success_once", "success_at_end", "first_success", "steps", "ending"):
        if getattr(there, name) != getattr(here, name):
            return f"{_in_words(there)} there, {_in_words(here)} here"
    if here.steps != recorded:
        return f"{recorded} recorded actions there, {_in_words(here)} here"
    if there.instruction != here.instruction:
        return f"{_cut(there.instruction)!r} there, {_cut(here.instruction)!r} here"
    returns = there.episode_return, here.episode_return
    if not math.isclose(*returns, rel_tol=DRIFT, abs_tol=DRIFT):
        return f"return {returns[0]:.6g} there, {returns[1]:.6g} here"
    return None


def _in_words(result: EpisodeResult) -> str:
    """Return the outcome of an episode: "solved at step 5, truncated after 20 steps"."""
    if result.status != "done":
        return f"an error of the policy after {result.steps} steps ({_cut(result.error or '')})"
    solved = "not solved"
    if result.success_once:
        solved = f"solved at step {result.first_success}"
        if not result.success_at_end:
            solved += ", not at the end"
    return f"{solved}, {result.ending.replace('_', ' ')} after {result.steps} steps"


def _cut(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LENGTH else f"{line[:_LENGTH]}…"


def _rates(results: Results) -> Iterator[ReproducedRate]:
    """Yield the rate of each case and, for a policy with several cases, of its cases with the same
    clock.
    """
    for policy_id in results.policy_ids:
        cases = results.of(policy_id)
        for case in cases:
            yield _rate(group_of((policy_id, case.suite, case.env), [case]), case.task)
        if len(cases) > 1:
            for timing, members in by_timing(cases).items():
                group = group_of((policy_id, "", TOTAL), members)
                yield _rate(group, f"{TOTAL}, {timing}")


def _rate(group: Group, env: str) -> ReproducedRate:
    bounds = group.with_lost(group.success_once)
    return ReproducedRate(group.policy_id, env, group.planned, group.success_once, bounds)


def _differences(case: CaseResults, *, trust: bool) -> list[Change]:
    """Return the versions of software, and the files of the case's environment, that are not those
    here.
    """
    here: Program = software()
    there: Program = {name: case.program.get(name, "") for name in here}
    if case.settings.get("robot") is None:
        # The episodes report an environment that cannot be created here.
        with contextlib.suppress(VLAgentsError):
            if not trust:
                require_harmless(case)
            here = here | files_of_env(
                case.env,
                case.settings.get("env_options") or {},
                case.settings.get("reset_options") or {},
            )
            there = case.program
    return program_changes(f"env {case.env}", there, here)


# Options that choose code, even if their values are words.
_CODE = re.compile("trust.*|module|source_dir")
_WORD = re.compile(r"\w[\w.+-]{0,63}")  # a text value that is not a path, URL or "module:Class"


def require_harmless(case: CaseResults) -> None:
    """Raise `ConfigError` if creating this environment could run other code than that of a
    registered environment.

    A bundle may come from a stranger: "module:Class" would be imported, and an option that is a
    path or a nested value could name files or code of this machine. `trust_remote_code` from a
    bundle is rejected: only the local user can grant it.
    """
    # Gymnasium imports the module before the slash of an id.
    has_module = env_suite(case.env) == "gymnasium" and "/" in (env_task(case.env) or "")
    if env_suite(case.env) not in names("envs") or ":" in case.env or has_module:
        raise ConfigError(
            f"{case.env}: is not a registered environment; --trust creates it, and runs its code"
        )
    for kind in ("env_options", "reset_options"):
        risky = {}
        for name, value in (case.settings.get(kind) or {}).items():
            if _CODE.fullmatch(name) or not _is_plain(value):
                risky[name] = value
        if risky:
            raise ConfigError(
                f"{case.env}: expected {kind} that cannot name files or code, got {risky}; give "
                "--trust if you trust their author"
            )


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(_is_plain(item) for item in value)
    if isinstance(value, str):
        return _WORD.fullmatch(value) is not None
    return value is None or isinstance(value, bool | int | float)
