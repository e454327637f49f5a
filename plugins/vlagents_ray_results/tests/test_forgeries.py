"""Tests that a forged bundle is contradicted: each column and each recording is changed separately,
as the author could.
"""

# ruff: noqa: S608 (the SQL is made of constants)

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from eval_fakes import LINE, ToZero
from in_process_evaluation import flat_config, play

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.results.database import SCHEMA
from vlagents_ray.interface import Act, Obs
from vlagents_ray_results.bundle import pack, unpack, write_bundle
from vlagents_ray_results.verification import Verification, verify

Forge = Callable[..., Verification]
EPISODES = 6
SOLVED = "episode = (SELECT min(episode) FROM episodes WHERE success_once)"
FAILED = "episode = (SELECT min(episode) FROM episodes WHERE NOT success_once)"


class Versioned(ToZero):
    """Reports its checkpoint, weights and version, like a served policy."""

    def reset(
        self, obs: Obs, instruction: str | None = None, **kwargs: object
    ) -> dict[str, object]:
        super().reset(obs, instruction, **kwargs)
        return {"checkpoint": "a", "weights": "sha256:5711", "revision": "0a1b"}

    def act(self, obs: Obs) -> Act:
        act = super().act(obs)
        act.info["policy"] = {"version": 0, "fingerprint": "f0"}
        return act


# By column: the new values, as SQL, and the rows in which they are set.
FORGERIES: dict[str, list[tuple[str, str]]] = {
    "key": [("key || 'x'", SOLVED)],
    "case_id": [("'0123456789abcdef'", SOLVED)],
    "env": [("'tabletop'", SOLVED)],
    "episode": [("episode + 100", SOLVED)],
    "seed": [("seed + 100", SOLVED)],
    "status": [
        ("'infra_failed'", FAILED),
        ("'policy_error'", FAILED),
        ("'infra_failed'", SOLVED),
        ("'x'", FAILED),
    ],
    "success_once": [("1", FAILED), ("0", SOLVED), ("NULL", FAILED)],
    "success_at_end": [("1", FAILED), ("1 - success_at_end", SOLVED), ("NULL", FAILED)],
    "first_success": [
        ("3", FAILED),
        ("NULL", SOLVED),
        ("first_success - 1", SOLVED),
        ("0", SOLVED),
    ],
    "steps": [("steps - 1", SOLVED), ("steps + 1", FAILED)],
    "episode_return": [("episode_return + 1", SOLVED)],
    "ending": [("'terminated'", SOLVED), ("'policy_done'", FAILED), ("'error'", FAILED)],
    "instruction": [("'another task'", SOLVED)],
    "error": [("'policy_failed: no'", FAILED)],
    "latency_ms": [("5.0", SOLVED)],
    "ticks_waited": [("1", SOLVED)],
    "ticks": [("1", SOLVED)],
    "starved": [("1", SOLVED)],
    "age_p50_ms": [("5.0", SOLVED)],
    "age_p95_ms": [("5.0", SOLVED)],
    "age_p99_ms": [("5.0", SOLVED)],
    "checkpoint": [("'b'", SOLVED)],
    "weights": [("'sha256:0'", SOLVED)],
    "policy_version": [("1", SOLVED), ("NULL", SOLVED)],
    "first_policy_version": [("1", SOLVED), ("NULL", SOLVED)],
    "policy_fingerprint": [("'f1'", SOLVED)],
    "actions_sha256": [("'00'", SOLVED), ("NULL", SOLVED)],
    "trajectory": [
        ("NULL", FAILED),
        (f"(SELECT trajectory FROM episodes WHERE {FAILED})", SOLVED),
        (f"(SELECT trajectory FROM episodes WHERE {SOLVED})", FAILED),
    ],
    "env_program": [("'0123456789abcdef'", SOLVED)],
    "policy_program": [("'0123456789abcdef'", SOLVED)],
    "run": [("7", SOLVED)],
}
_OF_THE_MACHINE = (
    "a time or a count of that machine, which nothing else records; affects no success rate"
)
UNKNOWN = {
    **dict.fromkeys(
        ("seconds", "reset_ms", "env_step_ms", "env_seconds", "finished"), _OF_THE_MACHINE
    ),
    **dict.fromkeys(
        ("policy_ms", "policy_p95_ms", "policy_seconds", "timing_ms", "attempts"), _OF_THE_MACHINE
    ),
    "acts": "the recording has actions, but not the answers that contained them; affects no "
    "success rate",
    "transport": "the transport of the observations, which nothing else records; affects no "
    "success rate",
    "revision": "known only on machines with the weights in the hub's cache; affects no success "
    "rate",
    "videos": "a bundle has videos only on request; they are for viewing",
    "start": "the initial state as the environment showed it; affects intervals only",
}
# By array of a recording: a change that keeps the array's shape.
CHANGED_ARRAYS: dict[str, Callable[[Trajectory], object]] = {
    "actions": lambda recorded: recorded.actions + np.float32(0.25),
    "rewards": lambda recorded: recorded.rewards + 0.25,
    "success": lambda recorded: ~recorded.success,
    "versions": lambda recorded: recorded.versions + 1,
    "state": lambda recorded: {part: values[:-1] for part, values in recorded.state.items()},
    "gripper": lambda recorded: np.ones(len(recorded.actions), np.float32),
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of recorded episodes, some of which are solved."""
    out = tmp_path_factory.mktemp("honest") / "run"
    options = {"envs": [LINE], "episodes": EPISODES, "seed": 3, "record": "all", "video": "none"}
    results = play(flat_config(**options, out=out), Versioned)
    outcomes = {one.success_once for one in results.cases[0].counted}
    assert outcomes == {True, False}, "both kinds of outcomes can be forged"
    return out


@pytest.fixture
def forged(honest: Path, tmp_path: Path) -> Forge:
    """Return a function that changes the files of a bundle, writes a new manifest, as the author
    could, and verifies the bundle.
    """

    def make(change: Callable[[Path], None], replay: int = EPISODES) -> Verification:
        write_bundle(honest, tmp_path / "honest.zip")
        unpack(tmp_path / "honest.zip", tmp_path / "files")
        change(tmp_path / "files")
        pack(tmp_path / "files", tmp_path / "forged.zip")
        return verify(tmp_path / "forged.zip", replay=replay, trust=True)

    return make


def columns_of_episodes() -> set[str]:
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(SCHEMA)
        return {name for (name,) in db.execute("SELECT name FROM pragma_table_info('episodes')")}


def update(sql: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with closing(sqlite3.connect(folder / "results.db")) as db, db:
            changed = db.execute(sql).rowcount
        assert changed, "the forgery changes a row"

    return change


def one_of_each() -> Iterator[tuple[str, str, str]]:
    for column, changes in FORGERIES.items():
        for value, rows in changes:
            yield column, value, rows


def test_every_column_is_checked_or_named_with_the_reason_why_it_cannot_be() -> None:
    assert not FORGERIES.keys() & UNKNOWN.keys()
    assert FORGERIES.keys() | UNKNOWN.keys() == columns_of_episodes()


def test_the_honest_bundle_holds(forged: Forge) -> None:
    found = forged(lambda _: None)
    assert {one.verdict for one in found.findings} == {"equal"}
    assert len([one for one in found.findings if one.subject.startswith("replay")]) == EPISODES


@pytest.mark.slow
@pytest.mark.parametrize(("column", "value", "rows"), list(one_of_each()))
def test_a_column_that_is_changed_alone_contradicts_the_bundle(
    forged: Forge, column: str, value: str, rows: str
) -> None:
    change = update(f"UPDATE episodes SET {column} = {value} WHERE {rows}")
    # This is also a contradiction, as no evaluation writes this value.
    with contextlib.suppress(ConfigError):
        found = forged(change)
        assert not found.holds, [(one.subject, one.verdict) for one in found.findings]


@pytest.fixture(scope="module")
def in_real_time(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of recorded episodes of a policy whose answers take two ticks."""
    out = tmp_path_factory.mktemp("real_time") / "run"
    options = {"envs": [LINE], "episodes": 3, "seed": 3, "record": "all", "video": "none"}
    clock = {"latency": 0.2, "neutral": [0]}
    results = play(flat_config(**options, clock=clock, out=out), lambda: Versioned(chunk=4))
    assert all(result.starved for result in results.cases[0].counted)
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        "ticks = NULL",
        "ticks = ticks + 1",
        "starved = NULL",
        "starved = ticks_waited + 1",
        "starved = -1",
        "age_p50_ms = -1.0",
        "age_p50_ms = NULL",
        "age_p95_ms = age_p99_ms + 1",
        "age_p99_ms = 0.0",
        "age_p50_ms = NULL, age_p95_ms = NULL, age_p99_ms = NULL",
        "starved = ticks, ticks_waited = ticks",
    ],
)
def test_ticks_in_time_that_cannot_be_contradict_the_bundle(
    in_real_time: Path, tmp_path: Path, changes: str
) -> None:
    write_bundle(in_real_time, tmp_path / "honest.zip")
    assert verify(tmp_path / "honest.zip", replay=0).holds
    unpack(tmp_path / "honest.zip", tmp_path / "files")
    update(f"UPDATE episodes SET {changes}")(tmp_path / "files")
    pack(tmp_path / "files", tmp_path / "forged.zip")
    found = verify(tmp_path / "forged.zip", replay=0)
    assert "differs" in {one.verdict for one in found.findings if one.subject == "episodes"}


@pytest.mark.parametrize("column", ["status", "success_once", "success_at_end", "first_success"])
def test_a_changed_outcome_is_found_without_the_simulator(forged: Forge, column: str) -> None:
    value, rows = FORGERIES[column][0]
    change = update(f"UPDATE episodes SET {column} = {value} WHERE {rows}")
    assert not forged(change, replay=0).holds


def test_all_columns_of_an_outcome_that_are_changed_together_contradict_the_recording(
    forged: Forge,
) -> None:
    outcome = "success_once = 1, success_at_end = 1, first_success = steps"
    found = forged(update(f"UPDATE episodes SET {outcome} WHERE {FAILED}"))
    assert {one.subject for one in found.findings if one.verdict == "differs"} >= {"trajectories"}


@pytest.mark.parametrize(
    "name", [field.name for field in fields(Trajectory) if field.name != "cameras"]
)
def test_a_recording_that_is_changed_alone_contradicts_the_bundle(forged: Forge, name: str) -> None:
    def change(folder: Path) -> None:
        path = min(folder.rglob("*.npz"))
        recorded = Trajectory.load(path)
        path.write_bytes(replace(recorded, **{name: CHANGED_ARRAYS[name](recorded)}).to_bytes())

    assert not forged(change).holds


OUTCOME = (
    "success_once",
    "success_at_end",
    "first_success",
    "steps",
    "episode_return",
    "ending",
    "actions_sha256",
)


def test_a_failure_with_outcome_and_recording_of_a_success_is_found_by_its_replay(
    forged: Forge,
) -> None:
    """The table and the recordings agree with each other, and every value was measured in some
    episode.
    """

    def copy(folder: Path) -> None:
        with closing(sqlite3.connect(folder / "results.db")) as db, db:
            [success] = db.execute(
                f"SELECT trajectory, {', '.join(OUTCOME)} FROM episodes WHERE {SOLVED}"
            ).fetchall()
            [[failure]] = db.execute(f"SELECT trajectory FROM episodes WHERE {FAILED}").fetchall()
            values = ", ".join(f"{column} = ?" for column in OUTCOME)
            db.execute(
                f"UPDATE episodes SET {values} WHERE trajectory = ?", [*success[1:], failure]
            )
        (folder / failure).write_bytes((folder / success[0]).read_bytes())

    found = forged(copy)
    assert not found.holds
    assert next(one.subject for one in found.findings if one.verdict == "differs").startswith(
        "replay of"
    )


def test_a_recording_of_an_episode_that_was_left_out_is_named(forged: Forge) -> None:
    found = forged(update(f"DELETE FROM episodes WHERE {FAILED}"))
    [detail] = [one.detail for one in found.findings if one.verdict == "differs"]
    assert "is the recording of no episode" in detail


@pytest.mark.parametrize(
    "sql",
    [
        f"UPDATE cases SET planned = {EPISODES // 2}",
        "UPDATE cases SET seeds = '[400]'",
        """UPDATE cases SET stop = '{"error_rate": 0.05, "width": 0.9}'""",
        """UPDATE cases SET settings = replace(settings, '"execute":null', '"execute":1')""",
        "UPDATE cases SET env = 'tabletop'",
        "UPDATE cases SET policy = 'another'",
    ],
)
def test_a_changed_case_that_would_leave_episodes_out_contradicts_the_bundle(
    forged: Forge, sql: str
) -> None:
    assert not forged(update(sql)).holds


@pytest.mark.slow
def test_replayed_episodes_are_drawn_by_a_seed_and_each_can_be(
    honest: Path, tmp_path: Path
) -> None:
    write_bundle(honest, tmp_path / "run.zip")

    def replayed(seed: int | None) -> str:
        found = verify(tmp_path / "run.zip", replay=1, seed=seed, trust=True)
        assert seed in (None, found.seed)
        [subject] = [one.subject for one in found.findings if one.subject.startswith("replay")]
        return subject

    drawn = {seed: replayed(seed) for seed in range(40)}
    assert len(set(drawn.values())) == EPISODES
    assert replayed(7) == drawn[7]
    assert len({verify(tmp_path / "run.zip", replay=0).seed for _ in range(3)}) > 1
