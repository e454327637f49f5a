"""Tests that an episode of a bundle is reproduced only if its recorded actions have the recorded
outcome here, whatever its author wrote.
"""

# ruff: noqa: S608 (the SQL is made of constants)

from __future__ import annotations

import io
import itertools
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import LINE, Line, ToZero
from in_process_evaluation import flat_config, play

from vlagents_ray import Act
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray_results.bundle import pack, unpack, write_bundle
from vlagents_ray_results.verification import Verification, verify

Arrays = dict[str, np.ndarray]
EPISODES = 6
# Columns of the outcome that an author changes, as SQL: one that adds a success, and one that
# hides it.
CLAIMS = {
    "nothing": "key = key",
    "success": "success_once = 1, success_at_end = 1, first_success = steps",
    "failure": "success_once = 0, success_at_end = 0, first_success = NULL",
    "earlier success": "success_once = 1, success_at_end = 1, first_success = 2",
    "another number of steps": "steps = steps + 1",
    "another ending": "ending = 'policy_done'",
    "an end of the simulator": "ending = 'terminated'",
    "another return": "episode_return = episode_return + 5",
    "another instruction": "instruction = 'stand still'",
}
KEPT = "nothing"


def run(tmp_path: Path, episodes: int, **options: Any) -> Path:
    """Return the folder of recorded episodes, some of which are solved."""
    out = tmp_path / "run"
    play(
        flat_config(envs=[LINE], episodes=episodes, record="all", video="none", out=out, **options)
    )
    return out


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bundle of episodes of which some are solved."""
    folder = tmp_path_factory.mktemp("honest")
    write_bundle(run(folder, EPISODES, seed=3), folder / "honest.zip")
    return folder / "honest.zip"


@pytest.fixture
def forged(honest: Path, tmp_path: Path) -> Callable[[Callable[[Path], None]], Path]:
    """Return a function that changes the files of a bundle, and writes a new manifest, as the
    author could.
    """

    def make(change: Callable[[Path], None]) -> Path:
        unpack(honest, tmp_path / "files")
        change(tmp_path / "files")
        pack(tmp_path / "files", tmp_path / "forged.zip")
        return tmp_path / "forged.zip"

    return make


def update(folder: Path, sql: str) -> None:
    with closing(sqlite3.connect(folder / "results.db")) as db, db:
        assert db.execute(sql).rowcount, "the forgery changes a row"


def solved_here(verification: Verification) -> tuple[int, int]:
    """Return the numbers of successes and of episodes of the printed rate."""
    [rate] = verification.rates
    return rate.success_once.successes, rate.success_once.episodes


# Changes of an array of a recording.


def appended(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values, values[-1:]])


def cut(values: np.ndarray) -> np.ndarray:
    return values[:-1]


def empty(values: np.ndarray) -> np.ndarray:
    return values[:0]


def reversed_(values: np.ndarray) -> np.ndarray:
    return values[::-1]


def negated(values: np.ndarray) -> np.ndarray:
    return ~values if values.dtype == bool else -values if values.dtype.kind in "fi" else values


def not_a_number(values: np.ndarray) -> np.ndarray:
    changed = values.copy()
    changed[-1:] = np.nan if values.dtype.kind == "f" else changed[:1]
    return changed


def infinite(values: np.ndarray) -> np.ndarray:
    return np.full_like(values, np.inf) if values.dtype.kind == "f" else values


def wider(values: np.ndarray) -> np.ndarray:
    return np.stack([values, values], axis=-1).reshape(len(values), -1)


def nested(values: np.ndarray) -> np.ndarray:
    return values[np.newaxis]


def doubles(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float64 if values.dtype.kind != "U" else object)


def complex_(values: np.ndarray) -> np.ndarray:
    return values.astype(np.complex64) if values.dtype.kind != "U" else values.astype("S")


def scalar(values: np.ndarray) -> np.ndarray:
    return np.array(0, values.dtype)


CHANGES = (
    appended, cut, empty, reversed_, negated, not_a_number, infinite, wider, nested, doubles,
    complex_, scalar,
)  # fmt: skip
ARRAYS = ("actions", "rewards", "success", "versions", "instructions", "state/position")


def mutations() -> Iterator[tuple[str, Callable[[Arrays], None]]]:
    """Yield changes of the arrays of a recording, and their names."""

    def changed(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[..., None]:
        def mutate(arrays: Arrays) -> None:
            arrays[name] = change(arrays[name])

        return mutate

    def removed(name: str) -> Callable[..., None]:
        return lambda arrays: arrays.__delitem__(name)

    for name in ARRAYS:
        for change in CHANGES:
            yield f"{name}, {change.__name__}", changed(name, change)
        yield f"{name}, removed", removed(name)

    def one_step_more(arrays: Arrays) -> None:
        for name, values in arrays.items():
            if name != "cameras":
                arrays[name] = appended(values)
        arrays["success"][-1], arrays["rewards"][-1] = True, 1.0

    def one_step_less(arrays: Arrays) -> None:
        for name, values in arrays.items():
            if name != "cameras":
                arrays[name] = cut(values)

    def success_without_a_number(arrays: Arrays) -> None:
        arrays["actions"][-1], arrays["success"][-1], arrays["rewards"][-1] = np.nan, True, 1.0

    yield "a step after the end", one_step_more
    yield "no last step", one_step_less
    yield "a success by an action that is not a number", success_without_a_number


@pytest.mark.slow
@pytest.mark.parametrize("claim", CLAIMS)
def test_no_change_of_a_recording_reproduces_an_outcome_that_its_actions_do_not_have(
    tmp_path: Path, claim: str
) -> None:
    """Each episode of the bundle has another change of its recording, and all have the claim."""
    changes = list(mutations())
    folder = run(tmp_path, len(changes), seed=3)
    [before] = Results.load(folder).cases
    true_successes: dict[int, list[bool]] = {}
    for episode in before.episodes:
        key, path = episode.result.key, folder / str(episode.trajectory)
        with np.load(path) as file:
            arrays = {name: file[name].copy() for name in file.files}
        changes[key.episode][1](arrays)
        true_successes[key.episode] = successes_of(arrays.get("actions", np.empty(0)), key.seed)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)
        path.write_bytes(buffer.getvalue())

    update(folder, f"UPDATE episodes SET {CLAIMS[claim]}")
    write_bundle(folder, tmp_path / "forged.zip")
    [after] = Results.load(folder).cases
    verification = verify(tmp_path / "forged.zip", trust=True)
    reproduced = {episode.episode for episode in verification.episodes if episode.is_reproduced}
    assert len(verification.episodes) == len(changes)
    for episode in after.episodes:
        result = episode.result
        if result.key.episode not in reproduced:
            continue
        change = changes[result.key.episode][0]
        successes = true_successes[result.key.episode]
        assert (result.steps, result.ending, len(successes)) == (10, "truncated", 10), change
        assert result.success_once == any(successes), change
        assert result.success_at_end == successes[-1], change
        first = next((step for step, solved in enumerate(successes, 1) if solved), None)
        assert result.first_success == first, change
        assert result.instruction == before.episodes[result.key.episode].result.instruction, change

    if claim == KEPT:
        assert len(reproduced) >= len(ARRAYS), "some changes leave the actions as they are"


def successes_of(actions: np.ndarray, seed: int) -> list[bool]:
    """Return the successes of actions in the environment `Line`, computed independently; empty if
    the actions cannot be executed.
    """
    if actions.ndim != 2 or not np.isrealobj(actions) or not np.isfinite(actions).all():
        return []
    position = float(np.random.default_rng(seed).uniform(2.0, 12.0))
    successes = []
    for action in actions:
        position += float(np.clip(action[0], -1.0, 1.0))
        successes.append(abs(position) < 0.5)
    return successes


# Ways in which a simulator here can disagree with the simulator of the author.
Stepped = tuple[Any, float, bool, bool, dict[str, Any]]


def raising(self: Line, stepped: Stepped) -> Stepped:
    raise RuntimeError("this episode is over")


def ending(self: Line, stepped: Stepped) -> Stepped:
    obs, reward, _, truncated, info = stepped
    return obs, reward, True, truncated, info


def reaching_a_limit(self: Line, stepped: Stepped) -> Stepped:
    obs, reward, terminated, _, info = stepped
    return obs, reward, terminated, True, info


def without_a_reward(self: Line, stepped: Stepped) -> Stepped:
    obs, _, terminated, truncated, info = stepped
    return obs, float("nan"), terminated, truncated, info


def rewarding(self: Line, stepped: Stepped) -> Stepped:
    obs, reward, terminated, truncated, info = stepped
    return obs, reward - 8.0, terminated, truncated, info


def succeeding(self: Line, stepped: Stepped) -> Stepped:
    obs, reward, terminated, truncated, _ = stepped
    return obs, reward, terminated, truncated, {"success": True}


def moving(self: Line, stepped: Stepped) -> Stepped:
    self._position += 6.0
    return stepped


def diverging(self: Line, stepped: Stepped) -> Stepped:
    obs, *others = stepped
    return replace(obs, state={"position": np.full(1, np.nan, np.float32)}), *others  # type: ignore[return-value]


# What the environment does differently in its second step, and a part of the reasons.
SECOND_STEPS = {
    raising: "this episode is over",
    ending: "terminated after 2 steps here",
    reaching_a_limit: "truncated after 2 steps here",
    without_a_reward: "expected a finite number as the reward",
    rewarding: "return ",
    succeeding: "solved at step 2",
    moving: " here",
    diverging: "here: env step: ",
}


def cannot_begin(*_: object, **__: object) -> None:
    raise RuntimeError("no scene")


# What it does differently from the start.
STARTS: dict[str, tuple[str, Any, str]] = {
    "raises in reset": ("reset", cannot_begin, "here: "),
    "cannot be made": ("__init__", cannot_begin, "could not be executed: "),
    "has another instruction": ("instruction", "stand still", "'stand still' here"),
    "has more time": ("max_steps", 12, "policy done after 10 steps here"),
    "has less time": ("max_steps", 9, "truncated after 9 steps here"),
}


def require_none_reproduced(bundle: Path, part: str) -> list[str]:
    """Check that no episode is reproduced and that each reason has this part; return the
    reasons.
    """
    verification = verify(bundle, trust=True)
    assert (verification.reproduced, len(verification.episodes)) == (0, EPISODES)
    assert not verification.is_complete
    [rate] = verification.rates
    assert (rate.success_once.rate, rate.with_others) == (None, (0.0, 1.0))
    reasons = [str(episode.reason) for episode in verification.episodes]
    assert all(part in reason for reason in reasons), reasons
    return reasons


@pytest.mark.parametrize("change", SECOND_STEPS)
def test_nothing_is_reproduced_in_a_simulator_with_another_step(
    honest: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Line, Stepped], Stepped]
) -> None:
    step = Line.step

    def stepped(self: Line, act: Act) -> Stepped:
        returned = step(self, act)
        return change(self, returned) if self._steps == 2 else returned

    monkeypatch.setattr(Line, "step", stepped)
    reasons = require_none_reproduced(honest, SECOND_STEPS[change])
    assert not [reason for reason in reasons if reason.startswith("could not be executed")]


@pytest.mark.parametrize("way", STARTS)
def test_nothing_is_reproduced_in_a_simulator_with_another_start(
    honest: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    name, value, part = STARTS[way]
    monkeypatch.setattr(Line, name, value)
    require_none_reproduced(honest, part)


# Bundles whose author changed more than a recording.


SOLVED = "episode = (SELECT min(episode) FROM episodes WHERE success_once)"
FAILED = "episode = (SELECT min(episode) FROM episodes WHERE NOT success_once)"


def all_solved(folder: Path) -> None:
    update(folder, f"UPDATE episodes SET {CLAIMS['success']}")


def actions_of_a_success(folder: Path) -> None:
    """Each failure has the outcome and the recording of a success."""
    columns = "success_once, success_at_end, first_success, steps, episode_return, trajectory"
    update(
        folder,
        f"UPDATE episodes SET ({columns}) = (SELECT {columns} FROM episodes WHERE {SOLVED}) "
        "WHERE NOT success_once",
    )


def recordings_removed(folder: Path) -> None:
    update(folder, "UPDATE episodes SET trajectory = NULL WHERE NOT success_once")
    all_solved(folder)


def recordings_of_nothing(folder: Path) -> None:
    for path in folder.rglob("*.npz"):
        path.write_bytes(b"not a recording")
    all_solved(folder)


def an_easier_env(folder: Path) -> None:
    """The author ran an environment that grants success, of the same name."""
    update(folder, "UPDATE cases SET program = replace(program, 'sha256:', 'sha256:00')")
    all_solved(folder)


def errors_of_the_policy(folder: Path) -> None:
    update(folder, "UPDATE episodes SET status = 'policy_error', ending = 'error', error = 'x'")
    all_solved(folder)


FORGERIES = (
    all_solved, actions_of_a_success, recordings_removed, recordings_of_nothing, an_easier_env,
    errors_of_the_policy,
)  # fmt: skip


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_rate_includes_no_success_that_does_not_happen_here(
    forged: Callable[..., Path], honest: Path, forgery: Callable[[Path], None]
) -> None:
    true_successes, _ = solved_here(verify(honest, trust=True))
    verification = verify(forged(forgery), trust=True)
    successes, episodes = solved_here(verification)
    assert successes <= true_successes
    assert episodes < EPISODES
    assert not verification.is_complete
    [rate] = verification.rates
    assert rate.with_others is not None
    low, high = rate.with_others
    assert low <= true_successes / EPISODES <= high


def test_an_honest_bundle_is_reproduced_with_its_rate(honest: Path) -> None:
    verification = verify(honest, trust=True)
    assert verification.is_complete
    assert (verification.reproduced, verification.counted) == (EPISODES, EPISODES)
    assert {episode.reason for episode in verification.episodes} == {None}
    assert {episode.policy for episode in verification.episodes} == {"policy"}
    [rate] = verification.rates
    assert 0 < rate.success_once.successes < rate.success_once.episodes == EPISODES
    assert (rate.with_others, verification.differences) == (None, ())


@pytest.mark.parametrize("latency", [0.0, 0.2])
def test_a_run_in_real_time_is_reproduced_by_its_executed_actions(
    tmp_path: Path, latency: float
) -> None:
    clock = {"latency": latency, "neutral": [0]}
    out = tmp_path / "run"
    config = flat_config(envs=[LINE], episodes=3, record="all", video="none", clock=clock, out=out)
    play(config, lambda: ToZero(chunk=4))
    write_bundle(out, tmp_path / "run.zip")
    verification = verify(tmp_path / "run.zip", trust=True)
    assert verification.is_complete
    assert verification.has_clock


def test_an_episode_that_is_in_a_database_twice_is_refused(forged: Callable[..., Path]) -> None:
    def doubled(folder: Path) -> None:
        with closing(sqlite3.connect(folder / "results.db")) as db, db:
            db.execute("CREATE TEMP TABLE more AS SELECT * FROM episodes WHERE success_once")
            db.execute("UPDATE more SET key = key || '+'")
            db.execute("INSERT INTO episodes SELECT * FROM more")

    with pytest.raises(ConfigError, match="twice, which no evaluation writes"):
        verify(forged(doubled), trust=True)


def test_other_versions_of_software_and_other_files_are_named(forged: Callable[..., Path]) -> None:
    def elsewhere(folder: Path) -> None:
        update(
            folder,
            "UPDATE cases SET program = json_set(program, '$.\"software: numpy\"', 'version 1.0', "
            "'$.\"eval_fakes.py\"', 'sha256:00')",
        )

    verification = verify(forged(elsewhere), trust=True)
    assert verification.is_complete
    changes = {(change.subject, change.name): change for change in verification.differences}
    assert changes.keys() == {("software", "numpy"), (f"env {LINE}", "eval_fakes.py")}
    assert changes["software", "numpy"].was == "version 1.0"
    assert changes["software", "numpy"].now == f"version {np.__version__}"


@pytest.mark.slow
def test_drawn_episodes_are_determined_by_a_seed_and_each_can_be_drawn(honest: Path) -> None:
    def drawn(seed: int | None) -> int:
        verification = verify(honest, replay=1, seed=seed, trust=True)
        assert seed in (None, verification.seed)
        [episode] = verification.episodes
        return episode.episode

    by_seed = {seed: drawn(seed) for seed in range(40)}
    assert len(set(by_seed.values())) == EPISODES
    assert drawn(7) == by_seed[7]
    assert len({verify(honest, replay=0).seed for _ in range(3)}) > 1


def test_a_recording_has_the_form_that_its_reader_expects(tmp_path: Path) -> None:
    out = run(tmp_path, 1)
    [path] = out.rglob("*.npz")
    recorded = Trajectory.load(path)
    for name, change in itertools.product(("rewards", "success", "versions"), (appended, wider)):
        with pytest.raises(ValueError, match=rf"{name}: expected \d+ "):
            replace(recorded, **{name: change(getattr(recorded, name))})
