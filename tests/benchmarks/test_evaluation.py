"""Whole evaluations compared with other systems: all run the same plan, and a system that did not
is detected.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from peer_environment import peers_python

from benchmarks.environments import TIMED_ENV, EpisodeTimes, read_episode_times
from benchmarks.evaluation import (
    SPLIT,
    EvaluationPlan,
    Played,
    alone,
    our_run,
    play,
    ratios,
    their_runs,
)
from benchmarks.line_process import ProcessFailed
from benchmarks.peers import SCRIPTS
from vlagents_ray.envs import make_env
from vlagents_ray.envs.base import known_contract
from vlagents_ray.interface import Act

FEW = EvaluationPlan(episodes=4, workers=2, size=32, max_steps=3)


def play_here(notes: Path, seeds: range, steps: int = FEW.max_steps) -> None:
    with make_env(TIMED_ENV, **FEW.env(notes) | {"max_steps": steps}) as env:
        for seed in seeds:
            env.reset(seed=seed)
            while not env.step(Act(np.zeros(4, np.float32)))[3]:
                pass


def test_the_noted_tabletop_is_the_tabletop(tmp_path: Path) -> None:
    with (
        make_env(TIMED_ENV, **FEW.env(tmp_path)) as noted,
        make_env("tabletop", width=32, height=32) as plain,
    ):
        assert noted.contract == plain.contract == known_contract(TIMED_ENV, FEW.env(tmp_path))
        ours, theirs = noted.reset(seed=5)[0], plain.reset(seed=5)[0]
        assert np.array_equal(ours.cameras["front"], theirs.cameras["front"])


def test_an_episode_is_noted_when_it_has_ended(tmp_path: Path) -> None:
    play_here(tmp_path, range(7, 9))
    [notes] = read_episode_times(tmp_path).values()
    assert [(note.seed, note.steps) for note in notes] == [(7, 3), (8, 3)]
    assert notes[0].begun <= notes[0].ended <= notes[1].begun
    [file] = tmp_path.iterdir()
    file.write_text(file.read_text() + "1.0 2.0")  # the writer is in the middle of its line
    assert [list(each) for each in read_episode_times(tmp_path).values()] == [notes]


def test_a_slow_simulator_is_cpu_time(tmp_path: Path) -> None:
    """The slow step uses CPU time, not wall time, which would pass while another process has the
    core.
    """
    import time

    with make_env(TIMED_ENV, **FEW.env(tmp_path) | {"step_ms": 20.0}) as env:
        env.reset(seed=0)
        used = time.thread_time()
        env.step(Act(np.zeros(4, np.float32)))
        assert time.thread_time() - used >= 0.020


def test_a_rate_is_that_from_the_first_reset_to_the_last_step(tmp_path: Path) -> None:
    def run(_folder: Path, notes: Path) -> None:
        lines = [f"{100 + 3 * seed} {102 + 3 * seed} 3 {seed}\n" for seed in range(4)]
        for pid, mine in (("1", lines[:2]), ("2", lines[2:])):
            (notes / f"{pid}.txt").write_text("".join(mine))

    played = play(FEW, run, tmp_path / "fake")
    assert played.episodes_per_minute == pytest.approx(60 * 4 / 11)
    assert read_episode_times(tmp_path / "fake" / "notes")[2][0] == EpisodeTimes(106, 108, 3, 2)


def test_ours_says_how_busy_both_sides_were(tmp_path: Path) -> None:
    def run(folder: Path, notes: Path) -> None:
        play_here(notes, range(FEW.episodes))
        (folder / "results").mkdir()
        (folder / "results" / "summary.json").write_text('{"env_busy": 0.75, "policy_busy": 0.5}')

    played = play(FEW, run, tmp_path / "fake")
    assert (played.env_busy, played.policy_busy) == (0.75, 0.5)


@pytest.mark.slow
def test_ours_without_workers_plays_the_plan(tmp_path: Path) -> None:
    alone_here = replace(FEW, workers=0)
    assert play(alone_here, our_run(alone_here), tmp_path / "here").episodes_per_minute > 0


@pytest.mark.parametrize(("seeds", "steps"), [(range(3), 3), (range(1, 5), 3), (range(4), 2)])
def test_whoever_plays_something_else_is_not_compared(
    tmp_path: Path, seeds: range, steps: int
) -> None:
    with pytest.raises(ProcessFailed, match="want each of 4 once with 3"):
        play(FEW, lambda _folder, notes: play_here(notes, seeds, steps), tmp_path / "other")


def test_ratios_are_above_one_where_we_are_faster() -> None:
    found = ratios([Played(200, 10), Played(300, 30)], [Played(100, 20), Played(100, 15)])
    assert found == {"rounds": [2, 3], "median": 2.5, "wall_rounds": [2, 0.5], "wall_median": 1.25}


def test_the_peers_see_these_packages_and_nothing_else_of_ours(tmp_path: Path) -> None:
    place = Path(alone(tmp_path)["PYTHONPATH"].split(":")[0])
    assert sorted(one.name for one in place.iterdir()) == ["benchmarks", "vlagents_ray"]


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.parametrize("name", ["vla-eval", SPLIT])
@pytest.mark.server
def test_a_peer_plays_the_plan_by_its_own_command(tmp_path: Path, name: str) -> None:
    """`run-eval` sleeps 30 s at its start."""
    scripts = {"vlagents": SCRIPTS / "vlagents_peer.py", "vla-eval": SCRIPTS / "vla_eval_peer.py"}
    run = their_runs(FEW, scripts, peers_python(), alone(tmp_path))[name]
    assert play(FEW, run, tmp_path / name).episodes_per_minute > 0
    assert sys.executable != str(peers_python())
