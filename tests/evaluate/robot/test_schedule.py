"""The order of trials: balanced, and drawn by the key alone."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_trials import plan

from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.robot import Trial, planned_cells, schedule

keys = st.binary(min_size=8, max_size=40)


def drawn(key: bytes, policies: int, episodes: int, seeds: list[int]) -> list[Trial]:
    names = [{"name": f"p{number}", "url": "http://x"} for number in range(policies)]
    config = plan(Path("out"), policies=names, suite={"episodes": episodes, "seeds": seeds})
    return schedule(cells(config), key)


def order(trials: list[Trial]) -> list[tuple[str, int, str]]:
    return [(trial.job.cell.env, trial.scene, trial.job.cell.contender) for trial in trials]


@settings(max_examples=60, deadline=None)
@given(keys, st.integers(1, 5), st.integers(1, 13), st.sampled_from([[0], [0, 100], [7, 20, 400]]))
def test_every_policy_plays_every_scene_once_and_has_each_place_equally_often(
    key: bytes, policies: int, episodes: int, seeds: list[int]
) -> None:
    trials = drawn(key, policies, episodes, seeds)
    assert [trial.number for trial in trials] == list(range(1, len(trials) + 1))
    scenes: dict[tuple[str, int], list[str]] = {}
    for env, scene, name in order(trials):
        scenes.setdefault((env, scene), []).append(name)
    assert list(scenes) == [(env, n) for env in ("cups", "drawer") for n in range(1, episodes * len(seeds) + 1)]
    everyone = {f"p{number}" for number in range(policies)}
    assert all(len(names) == policies and set(names) == everyone for names in scenes.values())
    for env in ("cups", "drawer"):
        for part in range(len(seeds)):
            rows = [scenes[env, part * episodes + i + 1] for i in range(episodes)]
            for place in range(policies):
                counts = Counter(row[place] for row in rows)
                assert max(counts[name] for name in everyone) - min(counts[name] for name in everyone) <= 1
            for block in range(0, episodes - policies + 1, policies):
                assert all(len({row[p] for row in rows[block : block + policies]}) == policies for p in range(policies))


@settings(max_examples=20, deadline=None)
@given(keys, st.permutations(["a", "b", "c"]))
def test_the_key_decides_whatever_order_the_plan_names_policies_in(key: bytes, names: list[str]) -> None:
    def of(ordered: list[str]) -> list[tuple[str, int, str]]:
        config = plan(Path("out"), policies=[{"name": name, "url": "http://x"} for name in ordered])
        return order(schedule(cells(config), key))

    assert of(names) == of(["a", "b", "c"])


def test_the_draw_is_the_one_that_was_published() -> None:
    """Whoever has the key of an old evaluation can check its order with any later version."""
    found = [name for env, _, name in order(drawn(b"a published key", 3, 3, [0])) if env == "cups"]
    assert found == ["p1", "p0", "p2", "p2", "p1", "p0", "p0", "p2", "p1"]


def test_every_order_is_about_equally_likely_over_keys() -> None:
    first = Counter(order(drawn(f"key number {n}".encode(), 2, 1, [0]))[0][2] for n in range(400))
    assert 160 < first["p0"] < 240, "within four standard deviations of a fair coin"


def test_a_pair_has_the_key_of_the_same_scene() -> None:
    trials = drawn(b"some key", 2, 3, [5])
    for scene in range(1, 4):
        pair = [trial.job.key for trial in trials if trial.task == ("", "cups") and trial.scene == scene]
        assert {(key.episode, key.seed) for key in pair} == {(scene - 1, 5 + scene - 1)}
        assert len({key.settings for key in pair}) == 2


def test_tasks_are_those_of_the_plan_and_patterns_match_them(tmp_path: Path) -> None:
    assert [cell.env for cell in cells(plan(tmp_path, suite={"envs": ["dr*"]}))] == ["drawer", "drawer"]
    with pytest.raises(UnknownEnv, match="none of the plan's"):
        cells(plan(tmp_path, suite={"envs": ["kettle"]}))
    with pytest.raises(ConfigError, match="got no robot"):
        planned_cells(plan(tmp_path, robot={"arm": None}))
    pushed = [{"name": "base", "url": "http://x", "pushed_weights": {"version": 3, "fingerprint": "ab"}}]
    with pytest.raises(ConfigError, match="want checkpoints"):
        planned_cells(plan(tmp_path, policies=pushed))


@pytest.mark.parametrize("telling", [{"track": ["wandb"]}, {"rerun": "viewed"}])
def test_what_would_show_rates_or_policies_before_the_end_is_refused(tmp_path: Path, telling: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"{next(iter(telling))}.*before the end"):
        planned_cells(plan(tmp_path, **telling))


def test_results_of_the_robot_are_not_those_of_its_simulation(tmp_path: Path) -> None:
    tasks = {"tabletop": {"instruction": "push"}}
    real, simulated = (
        cells(plan(tmp_path, suite={"envs": ["tabletop"]}, robot={"arm": arm, "tasks": tasks}))[0]
        for arm in ("a:B", None)
    )
    assert real.fingerprint != simulated.fingerprint
    assert "robot" not in simulated.settings
    assert "key" not in real.settings["robot"]
