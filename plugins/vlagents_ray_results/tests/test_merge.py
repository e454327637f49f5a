"""Tests of merging several folders of results: each episode occurs once, contradictions are errors,
and the new folder is usable like any other.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import itertools
import json
import os
import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from in_process_evaluation import play

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.storage import require_below
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.replay import find
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.combination import combined
from vlagents_ray.evaluate.results.database import FILE
from vlagents_ray.evaluate.results.reader import is_sequential, rate_of
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.interface import Obs
from vlagents_ray_results.merge import merge

Config = Callable[..., EvalConfig]


class Served(ToZero):
    """Has metadata and a checkpoint, like a policy on a server."""

    def __init__(self, step: str) -> None:
        super().__init__()
        self.metadata = {"policy": "act", "checkpoint": f"step {step}"}

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        super().reset(obs, instruction, **kwargs)
        return {"checkpoint": self.metadata["checkpoint"]}


@pytest.fixture
def part(config: Config, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that makes a folder of results with the plan's episodes, except those that
    are left out.
    """

    def make(name: str, *left_out: int, chunk: int = 1, **changes: object) -> Path:
        settings = config(out=tmp_path / name, **changes)
        return play(settings, functools.partial(ToZero, chunk=chunk), left_out=left_out).out

    return make


def outcomes(results: Results) -> dict[str, object]:
    return {
        str(one.result.key): one.result.outcome for case in results.cases for one in case.episodes
    }


def test_a_folder_that_began_after_the_first_results_is_a_plan_that_grew(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    first, later = part("first"), part("later", seeds=[100])
    for folder in (first, later):
        assert not is_sequential(Results.load(folder).cases)
    for name, folders in (("ab", [first, later]), ("ba", [later, first])):
        merged = merge(tmp_path / name, folders).results
        assert is_sequential(merged.cases)

    # Plans of one moment are one plan.
    for folder in (first, later):
        with closing(sqlite3.connect(folder / FILE)) as db, db:
            db.execute("UPDATE cases SET planned_at = 1.0")
    assert not is_sequential(merge(tmp_path / "one", [first, later]).results.cases)


def test_parts_that_overlap_make_the_whole_each_episode_as_the_first_has_it(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    whole, a, b = part("whole"), part("a", 3, 4, 5), part("b", 0, 1)
    summary = merge(tmp_path / "out", [a, b])
    found = Results.load(tmp_path / "out")
    assert outcomes(found) == outcomes(Results.load(whole))
    assert [one.run for one in found.cases[0].episodes] == [1, 1, 1, 2, 2, 2]
    assert (summary.total.episodes, summary.total.planned) == (6, 6)
    assert (tmp_path / "out" / "summary.json").is_file()
    assert [(one.run, one.pid, one.transport) for one in found.workers] == [
        (run, os.getpid(), "local") for run in (1, 2)
    ]
    with pytest.raises(ConfigError, match="merge into a new folder"):
        merge(a, [a, b])


def test_a_merged_folder_is_resumed_like_any_other(
    part: Callable[..., Path], config: Config, tmp_path: Path
) -> None:
    a, b = part("a", 2, 3, 4, 5), part("b", 0, 1, 4, 5)
    merge(tmp_path / "out", [a, b])
    results = play(config(out=tmp_path / "out", resume=True))
    assert [(one.result.key.episode, one.run) for one in results.cases[0].episodes] == [
        (0, 1), (1, 1), (2, 2), (3, 2), (4, 3), (5, 3)
    ]  # fmt: skip


def test_other_envs_and_seeds_join_the_table_also_of_a_suite_that_was_renamed(
    part: Callable[..., Path], config: Config, tmp_path: Path
) -> None:
    renamed = config(out=tmp_path / "b", seed=100)
    suite = renamed.suites[0].model_copy(update={"name": "b"})
    play(renamed.model_copy(update={"suites": [suite]}))
    merge(tmp_path / "out", [part("a"), tmp_path / "b", part("c", envs=[OTHER_LINE])])
    cases = Results.load(tmp_path / "out").cases
    assert [(case.env, case.planned, len(case.counted)) for case in cases] == [
        (LINE, 12, 12),
        (OTHER_LINE, 6, 6),
    ]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": 3}, r"expected seeds 6 or more apart.*got \[3\], together \[0, 3\]"),
        ({"execute": 2}, r"Line has other settings: execute: None and 2"),
    ],
)
def test_seeds_that_play_an_episode_twice_and_other_settings_are_refused(
    part: Callable[..., Path], tmp_path: Path, changes: dict[str, int], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        merge(tmp_path / "out", [part("a"), part("b", **changes)])


def test_different_outcomes_are_listed_and_nothing_is_written(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    a, b = part("a"), part("b")
    with closing(sqlite3.connect(b / "results.db")) as db, db:
        db.execute(
            "UPDATE episodes SET success_once = 1 - success_once, seconds = 99 WHERE episode IN "
            "(2, 3)"
        )
    with pytest.raises(
        ConfigError, match=r"2 episodes have different outcomes:\n.*Line#2@2.*success_once is"
    ) as told:
        merge(tmp_path / "out", [a, b])
    assert "seconds" not in str(told.value)
    assert not (tmp_path / "out").exists()
    merge(tmp_path / "out", [a, b], keep_first=True)
    assert outcomes(Results.load(tmp_path / "out")) == outcomes(Results.load(a))


def test_a_lost_episode_gives_way_to_one_that_was_played(
    part: Callable[..., Path], config: Config, tmp_path: Path
) -> None:
    a, b = part("a", 5), part("b")
    with Store(resolve(config(out=a, resume=True))) as store:
        store.begin_run({})
        lost = EpisodeResult(plan_jobs(store.cases)[5].key, "infra_failed", error="it hung")
        store.record(lost, attempts=4)
    for order in ([a, b], [b, a]):
        out = tmp_path / order[0].name / "merged"
        merge(out, order)
        assert [one.result.status for one in Results.load(out).cases[0].episodes] == ["done"] * 6


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (
            lambda name: {"checkpoint": name},
            r"policy 'policy' has checkpoint 'y'.*before it have 'x'",
        ),
        (
            lambda name: {"checkpoint": "a", "weights": {"digest": name, "revision": None}},
            r"policy policy: weights was x, is y",
        ),
    ],
)
def test_a_policy_with_another_checkpoint_or_other_weights_is_named(
    tmp_path: Path, config: Config, said: Callable[[str], dict[str, object]], told: str
) -> None:
    folders = [tmp_path / name for name in ("x", "y")]
    for folder in folders:
        with Store(resolve(config(out=folder))) as store:
            store.begin_run({})
            store.note_policy("policy", {"policy": "act", **said(folder.name)})
    with pytest.raises(ConfigError, match=told):
        merge(tmp_path / "out", folders)


# By subject: the statement of a value, by the policy's server (metadata) or by the environment.
STATEMENTS: dict[str, Callable[[str], dict[str, object] | EnvInfo]] = {
    "program": lambda value: {"program": {"policy.py": value}},
    "settings": lambda value: {"config": {"gain": value}},
    "wrappers": lambda value: {"wrappers": [value]},
    "weights": lambda value: {"weights": {"digest": value, "revision": None}},
    "description": lambda value: EnvInfo({"simulator": value}, {}),
    "contract": lambda value: EnvInfo({}, {"task": value}),
}


def stated(store: Store, subject: str, value: str) -> None:
    """Record a statement; an empty value means that nothing is known of the subject."""
    statement = STATEMENTS[subject](value)
    of_the_env = isinstance(statement, EnvInfo)
    metadata = {"policy": "act", "checkpoint": "a"}
    if not of_the_env and value:
        metadata |= statement
    store.note_policy("policy", metadata)
    env = statement if of_the_env and value else EnvInfo({}, {})
    store.note_env(store.cases[0].place, env)


@pytest.mark.slow
@pytest.mark.parametrize("order", list(itertools.permutations(["", "x", "y"])))
@pytest.mark.parametrize("subject", STATEMENTS)
def test_a_part_of_which_nothing_is_known_hides_no_difference_of_the_others(
    tmp_path: Path, config: Config, subject: str, order: tuple[str, ...]
) -> None:
    folders = []
    for number, value in enumerate(order):
        folders.append(tmp_path / f"part{number}")
        with Store(resolve(config(out=folders[-1], seed=100 * number))) as store:
            store.begin_run({})
            stated(store, subject, value)
    with pytest.raises(ConfigError, match=r"was .*[xy].*, is .*[xy]"):
        merge(tmp_path / "out", folders)


@pytest.mark.slow
@pytest.mark.parametrize("order", list(itertools.permutations(["", "x", "y"])))
@pytest.mark.parametrize("subject", STATEMENTS)
def test_a_run_of_which_nothing_is_known_hides_no_difference_of_the_others(
    tmp_path: Path, config: Config, subject: str, order: tuple[str, ...]
) -> None:

    def resume_twice() -> None:
        for number, value in enumerate(order):
            with Store(resolve(config(resume=number > 0))) as store:
                store.begin_run({})
                stated(store, subject, value)
                store.end_run("complete")

    with pytest.raises(ConfigError, match=r"was .*[xy].*, is .*[xy]"):
        resume_twice()


@pytest.mark.slow
@pytest.mark.parametrize("order", list(itertools.permutations(["", "x", "y"])))
@pytest.mark.parametrize("subject", ["program", "settings", "wrappers", "weights"])
def test_a_report_keeps_a_policy_apart_also_after_a_folder_of_which_nothing_is_known(
    tmp_path: Path, config: Config, subject: str, order: tuple[str, ...]
) -> None:
    folders = []
    for env, value in zip((LINE, OTHER_LINE, "tabletop/lift"), order, strict=True):
        out = tmp_path / f"part{len(folders)}"
        with Store(resolve(config(out=out, envs=[env]))) as store:
            store.begin_run({})
            stated(store, subject, value)
        folders.append(Results.load(out))
    names = [case.policy for case in combined(folders).cases]
    assert names == ["policy (part0)", "policy (part1)", "policy (part2)"]


def test_in_a_sweep_each_server_may_have_begun_with_another_checkpoint(
    tmp_path: Path, config: Config
) -> None:
    folders = [tmp_path / step for step in ("10", "20")]
    for folder in folders:
        play(config(out=folder, steps=[int(folder.name)]), functools.partial(Served, folder.name))
    merge(tmp_path / "out", folders)
    assert [case.step for case in Results.load(tmp_path / "out").cases] == [10, 20]


def test_videos_and_trajectories_go_along_without_taking_room(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    options = {"env_options": {"camera": [32, 32]}, "record": "all", "video": "all"}
    a, b = part("a", 1, 2, 3, 4, 5, **options), part("b", 0, 2, 3, 4, 5, **options)
    merge(tmp_path / "out", [a, b])
    for episode, home in zip(Results.load(tmp_path / "out").cases[0].episodes, (a, b), strict=True):
        for path in [*episode.videos, str(episode.trajectory)]:
            assert os.path.samefile(tmp_path / "out" / path, home / path)
    names = {path.name for path in (tmp_path / "out" / "trajectories").rglob("*.mp4")}
    assert names == {"ep0000_seed0_front.mp4", "ep0001_seed1_front.mp4"}


@pytest.mark.parametrize("kind", ["videos", "trajectories"])
def test_a_file_of_an_episode_that_is_gone_is_said_in_one_sentence_and_nothing_is_written(
    part: Callable[..., Path], tmp_path: Path, kind: str
) -> None:
    a = part("a", env_options={"camera": [32, 32]}, record="all", video="all")
    [gone] = (a / kind).rglob("ep0003_*.mp4" if kind == "videos" else "ep0003_*.npz")
    gone.unlink()
    with pytest.raises(
        ConfigError, match=rf"{gone.name}: expected the file .*, got none; copy the folder again"
    ):
        merge(tmp_path / "out", [a])
    assert not list((tmp_path / "out").rglob("*.*"))
    write_report(Results.load(a), tmp_path / "report.html")


def named(folder: Path, column: str, path: str) -> Path:
    """Set the path of the first episode's files in the database, and return the folder."""
    value = json.dumps([path]) if column == "videos" else path
    with closing(sqlite3.connect(folder / "results.db")) as db, db:
        db.execute(f"UPDATE episodes SET {column} = ? WHERE episode = 0", (value,))  # noqa: S608 - a constant
    return folder


@pytest.mark.parametrize(
    "path",
    [
        "/etc/hostname",
        "../secret/key.mp4",
        "videos/../../secret/key.mp4",
        "..",
        "",
        "videos/\0.mp4",
    ],
)
def test_a_path_out_of_a_folder_of_results_is_refused(path: str) -> None:
    with pytest.raises(ConfigError, match="expected a file in the folder of results, got the path"):
        require_below(path)


@pytest.mark.parametrize("column", ["videos", "trajectory"])
def test_paths_out_of_a_folder_of_results_are_refused_by_all_that_read_it(
    part: Callable[..., Path], tmp_path: Path, column: str
) -> None:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key.mp4").write_text("secret")
    theirs = named(part("theirs"), column, "videos/../../secret/key.mp4")
    for read in (Results.load, lambda folder: merge(tmp_path / "out", [folder])):
        with pytest.raises(ConfigError, match="expected a file in the folder of results"):
            read(theirs)
    assert not list((tmp_path / "out").rglob("*.mp4"))


@pytest.mark.parametrize("of_the_folder", [False, True])
def test_symbolic_links_lead_no_further_than_their_folder(
    part: Callable[..., Path], tmp_path: Path, of_the_folder: bool
) -> None:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key.mp4").write_text("secret")
    theirs = named(part("theirs"), "videos", "v/key.mp4")
    if of_the_folder:
        (theirs / "v").symlink_to(tmp_path / "secret")
    else:
        (theirs / "v").mkdir()
        (theirs / "v" / "key.mp4").symlink_to(tmp_path / "secret" / "key.mp4")
    with pytest.raises(
        ConfigError,
        match=(
            r"v/key.mp4: expected a file in the folder .*, got a symbolic link .* copy of its "
            r"target"
        ),
    ):
        merge(tmp_path / "out", [theirs])
    other = part("other", execute=2)  # this folder is next to the secret file
    for results in (Results.load(theirs), combined([Results.load(theirs), Results.load(other)])):
        [path] = [video for case in results.cases for one in case.episodes for video in one.videos]
        with pytest.raises(ConfigError, match="got a symbolic link that leads out of it"):
            results.file(path)
        page = write_report(results, tmp_path / "page.html", inline=True).read_text()
        assert base64.b64encode(b"secret").decode() not in page


def test_a_difference_from_a_commit_that_is_a_link_is_not_copied(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    theirs = part("theirs")
    (theirs / "provenance").mkdir(exist_ok=True)
    (theirs / "provenance" / "x.diff").symlink_to("/etc/hostname")
    with pytest.raises(ConfigError, match=r"x\.diff: expected a file .*, got a symbolic link"):
        merge(tmp_path / "out", [theirs])


def test_links_within_a_folder_and_to_it_are_followed(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    a = named(part("a"), "videos", "v/key.mp4")
    (a / "w").mkdir()
    (a / "w" / "key.mp4").write_text("mine")
    (a / "v").symlink_to("w")
    (tmp_path / "alias").symlink_to(a)
    merge(tmp_path / "out", [tmp_path / "alias"])
    assert (tmp_path / "out" / "v" / "key.mp4").read_text() == "mine"
    assert not (tmp_path / "out" / "v").is_symlink()


def with_weights(folder: Path, weights: str) -> Path:
    """Change the database as if these weights had run all episodes, and return the folder."""
    with closing(sqlite3.connect(folder / "results.db")) as db:
        db.execute("UPDATE episodes SET weights = ?", (weights,))
        db.commit()
    return folder


def test_other_weights_under_the_same_name_are_not_merged(
    part: Callable[..., Path], tmp_path: Path
) -> None:
    a, b = with_weights(part("a", 3, 4, 5), "x"), with_weights(part("b", 0, 1, 2), "y")
    elsewhere = with_weights(part("c", envs=[OTHER_LINE]), "y")
    for other in (b, elsewhere):
        with pytest.raises(
            ConfigError,
            match=r"was run by several weights under one name: .*'x'.*'y'.*merge these",
        ):
            merge(tmp_path / "out", [a, other])
    with_weights(b, "x")
    merge(tmp_path / "same", [a, b])
    found = {
        one.result.weights
        for case in Results.load(tmp_path / "same").cases
        for one in case.episodes
    }
    assert found == {"x"}


def test_an_episode_is_replayed_after_a_merge_that_renamed_its_suite(
    config: Config, tmp_path: Path
) -> None:
    renamed = config(out=tmp_path / "b", seed=100, episodes=1)
    suite = renamed.suites[0].model_copy(update={"name": "b"})
    play(renamed.model_copy(update={"suites": [suite]}))
    play(config(out=tmp_path / "a", episodes=1))
    results = merge(tmp_path / "all", [tmp_path / "a", tmp_path / "b"]).results
    for number, episode in enumerate(results.cases[0].episodes):
        recorded = find(results, str(episode.result.key))
        replayed = play(recorded.config(tmp_path / f"again{number}"), left_out=[])
        played = [one.result.key for one in replayed.cases[0].episodes]
        assert episode.result.key in played


def test_a_folder_with_a_column_of_another_program_is_refused_and_nothing_is_written(
    config: Config, tmp_path: Path
) -> None:
    folder = play(config(episodes=1)).out
    with closing(sqlite3.connect(folder / "results.db")) as db, db:
        db.execute("ALTER TABLE episodes ADD COLUMN theirs")
    with pytest.raises(ConfigError, match=r"got the unknown columns .*theirs"):
        merge(tmp_path / "merged", [folder])
    assert not (tmp_path / "merged").exists()


@dataclasses.dataclass(frozen=True)
class Part:
    """A folder of results that one machine wrote, without a simulator."""

    seeds: tuple[int, ...] = (0,)
    episodes: int = 4
    stop: float | None = None  # target of early stopping
    suite: str = ""
    execute: int | None = None
    steps: tuple[int, ...] = ()
    checkpoint: str | None = None
    described: str | None = None
    program: str | None = None
    missing: frozenset[int] = frozenset()  # episodes without a result
    lost: frozenset[int] = frozenset()  # episodes lost to infrastructure
    other: frozenset[int] = frozenset()  # episodes with another outcome

    def write(self, out: Path) -> Path:
        """Write the folder `out`."""
        stop = None if self.stop is None else {"target": self.stop, "at_least": 2}
        policy: dict[str, Any] = {"name": "act", "execute": self.execute, "url": "http://a"}
        if self.steps:
            policy |= {"checkpoint": "run/{step}", "steps": list(self.steps)}
        suite = {
            "name": self.suite,
            "envs": [LINE],
            "episodes": self.episodes,
            "seeds": list(self.seeds),
        }
        plan = {"policies": [policy], "suites": [suite], "stop": stop, "out": out}
        with Store(resolve(EvalConfig.model_validate(plan))) as store:
            store.begin_run({}, 0.0)
            if self.checkpoint is not None:
                store.note_policy("act", {"policy": "act", "checkpoint": self.checkpoint})
            for job in plan_jobs(store.cases):
                if self.described is not None:
                    store.note_env(job.case.place, EnvInfo({"simulator": self.described}, {}))
                number = job.key.seed
                if number in self.missing:
                    continue
                solved = (number < 50) != (number in self.other)
                result = EpisodeResult(job.key, "done", solved, solved, 1 if solved else None)
                if number in self.lost:
                    result = EpisodeResult(job.key, "infra_failed", error="lost")
                store.record(result, attempts=1, finished=1.0)
            store.end_run("complete")
        if self.program is not None:
            with closing(sqlite3.connect(out / "results.db")) as db, db:
                db.execute("UPDATE cases SET program = ?", (self.program,))
        return out


_SOME = st.frozensets(st.sampled_from([0, 1, 2, 100, 101]), max_size=2)
PARTS = st.builds(
    Part,
    seeds=st.sampled_from([(0,), (0,), (100,), (0, 100), (100, 0), (2,)]),
    episodes=st.sampled_from([4, 4, 3]),
    stop=st.sampled_from([None, None, 0.5, 0.6]),
    suite=st.sampled_from(["", "", "lab"]),
    execute=st.sampled_from([None, None, None, 2]),
    steps=st.sampled_from([(), (), (), (10,)]),
    checkpoint=st.sampled_from([None, None, "a", "b"]),
    described=st.sampled_from([None, None, "1", "2"]),
    program=st.sampled_from([None, None, None, "{}", '{"a.py": "1"}']),
    missing=_SOME,
    lost=st.one_of(st.just(frozenset()), _SOME),
    other=st.one_of(st.just(frozenset()), st.just(frozenset()), _SOME),
)


def merged_in_order(folders: Sequence[Path], out: Path, *, accept_changes: bool) -> object:
    """Return all that a merge counts; None if it is refused."""
    try:
        results = merge(out, folders, accept_changes=accept_changes).results
    except ConfigError:
        return None
    cases = []
    for case in results.cases:
        names = (case.policy_id, case.suite, case.env, case.case_id)
        numbers = (case.planned, case.stopped_at, case.missing)
        outcomes = sorted((result.key.seed, result.success_once) for result in case.counted)
        cases.append((names, numbers, outcomes, rate_of([case], "success_once")))
    totals = {name: rate_of(results.of(name), "success_once") for name in results.policy_ids}
    return sorted(cases, key=str), totals


@pytest.mark.slow
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(parts=st.lists(PARTS, min_size=2, max_size=3), accept_changes=st.booleans())
# Both stopped early, at other seeds.
@example(parts=[Part(stop=0.5), Part(seeds=(100,), stop=0.5)], accept_changes=False)
# A suite has another name, and its name belongs to another suite.
@example(parts=[Part(suite="lab"), Part(), Part(execute=2)], accept_changes=False)
@example(parts=[Part(steps=(10,), checkpoint="a"), Part(checkpoint="b")], accept_changes=False)
@example(parts=[Part(seeds=(100, 0)), Part(seeds=(0, 100))], accept_changes=False)
def test_the_order_of_folders_changes_neither_a_rate_nor_whether_they_are_merged(
    tmp_path: Path, parts: list[Part], accept_changes: bool
) -> None:
    with tempfile.TemporaryDirectory(dir=tmp_path) as temporary:
        home = Path(temporary)
        folders = [part.write(home / str(number)) for number, part in enumerate(parts)]
        found = []
        for number, order in enumerate(itertools.permutations(folders)):
            out = home / f"merged-{number}"
            found.append(merged_in_order(order, out, accept_changes=accept_changes))
        assert all(one == found[0] for one in found), found
