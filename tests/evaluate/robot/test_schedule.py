"""The order of trials, which is balanced and depends only on the key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_trials import plan

from vlagents_ray.errors import ConfigError, UnknownEnv
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.robot import Trial, require_trials, schedule

keys = st.binary(min_size=8, max_size=40)
TASKS = ("cups", "drawer")


def drawn(
    key: bytes, policies: int, episodes: int, seeds: list[int], tasks: Sequence[str] = TASKS
) -> list[Trial]:
    names = [{"name": f"p{number}", "url": "http://x"} for number in range(policies)]
    robot = {"tasks": {task: {"instruction": f"use the {task}", "max_steps": 5} for task in tasks}}
    suite = {"envs": list(tasks), "episodes": episodes, "seeds": seeds}
    config = plan(Path("out"), policies=names, suite=suite, robot=robot)
    return schedule(plan_cases(config), key)


def order(trials: list[Trial]) -> list[tuple[str, int, str]]:
    return [(trial.job.case.env, trial.scene, trial.job.case.policy_id) for trial in trials]


def orders_by_task(trials: list[Trial]) -> dict[str, list[list[str]]]:
    """Return the order of the policies in each scene of each task, as they are run."""
    scenes: dict[tuple[str, int], list[str]] = {}
    for env, scene, name in order(trials):
        scenes.setdefault((env, scene), []).append(name)
    tasks: dict[str, list[list[str]]] = {}
    for (env, _), names in scenes.items():
        tasks.setdefault(env, []).append(names)
    return tasks


def imbalance(orders: list[list[str]]) -> int:
    """Return the largest difference between policies in how often they are first, second, and so
    on.
    """
    names = sorted(orders[0])
    differences = []
    for position in range(len(names)):
        counts = Counter(names_in_order[position] for names_in_order in orders)
        times = [counts[name] for name in names]
        differences.append(max(times) - min(times))
    return max(differences)


@settings(max_examples=60, deadline=None)
@given(keys, st.integers(1, 5), st.integers(1, 13), st.sampled_from([[0], [0, 100], [7, 20, 400]]))
def test_every_policy_plays_every_scene_once(
    key: bytes, policies: int, episodes: int, seeds: list[int]
) -> None:
    trials = drawn(key, policies, episodes, seeds)
    assert [trial.number for trial in trials] == list(range(1, len(trials) + 1))
    expected = [(task, scene) for task in TASKS for scene in range(1, episodes * len(seeds) + 1)]
    assert list(dict.fromkeys((task, scene) for task, scene, _ in order(trials))) == expected
    everyone = [f"p{number}" for number in range(policies)]
    for orders in orders_by_task(trials).values():
        assert all(sorted(names) == everyone for names in orders)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    keys,
    st.integers(1, 6),
    st.integers(1, 13),
    st.integers(1, 12),
    st.integers(1, 12),
)
def test_each_place_is_had_equally_often_whatever_the_shape_of_the_plan(
    key: bytes, policies: int, episodes: int, seeds: int, tasks: int
) -> None:
    """The order is balanced in each task and in the whole plan, even with one episode for many
    seeds or many tasks.
    """
    trials = drawn(
        key,
        policies,
        episodes,
        [100 * seed for seed in range(seeds)],
        [f"task{n}" for n in range(tasks)],
    )
    by_task = orders_by_task(trials)
    assert imbalance([names for orders in by_task.values() for names in orders]) <= 1
    for orders in by_task.values():
        assert imbalance(orders) <= 1
        for first in range(0, len(orders) - policies + 1, policies):
            square = orders[first : first + policies]
            assert imbalance(square) == 0, (
                "each block must be a Latin square, so that a task that stops early is balanced"
            )


@settings(max_examples=20, deadline=None)
@given(keys, st.permutations(["a", "b", "c"]))
def test_the_key_decides_whatever_order_the_plan_names_policies_in(
    key: bytes, names: list[str]
) -> None:
    def of(ordered: list[str]) -> list[tuple[str, int, str]]:
        config = plan(Path("out"), policies=[{"name": name, "url": "http://x"} for name in ordered])
        return order(schedule(plan_cases(config), key))

    assert of(names) == of(["a", "b", "c"])


def test_the_draw_is_the_one_of_earlier_evaluations() -> None:
    """The key of an evaluation reproduces its order later, so a change of the draw would be a
    breaking change.
    """
    found = [name for env, _, name in order(drawn(b"a published key", 3, 4, [0])) if env == "cups"]
    assert found == [
        *("p1", "p0", "p2"),
        *("p2", "p1", "p0"),
        *("p0", "p2", "p1"),
        *("p0", "p2", "p1"),
    ]


def test_every_order_is_about_equally_likely_over_keys() -> None:
    first = Counter(order(drawn(f"key number {n}".encode(), 2, 1, [0]))[0][2] for n in range(400))
    assert 160 < first["p0"] < 240, (
        "expected a value within four standard deviations of a fair coin"
    )


def test_a_pair_has_the_key_of_the_same_scene() -> None:
    trials = drawn(b"some key", 2, 3, [5])
    for scene in range(1, 4):
        pair = [
            trial.job.key for trial in trials if trial.task == ("", "cups") and trial.scene == scene
        ]
        assert {(key.episode, key.seed) for key in pair} == {(scene - 1, 5 + scene - 1)}
        assert len({key.settings for key in pair}) == 2


def test_tasks_are_those_of_the_plan_and_patterns_match_them(tmp_path: Path) -> None:
    assert [case.env for case in plan_cases(plan(tmp_path, suite={"envs": ["dr*"]}))] == [
        "drawer",
        "drawer",
    ]
    with pytest.raises(UnknownEnv, match="which matches none"):
        plan_cases(plan(tmp_path, suite={"envs": ["kettle"]}))
    with pytest.raises(ConfigError, match="got no robot"):
        require_trials(plan(tmp_path, robot={"arm": None}))
    pushed = [
        {"name": "base", "url": "http://x", "pushed_weights": {"version": 3, "fingerprint": "ab"}}
    ]
    with pytest.raises(ConfigError, match="expected none with a robot"):
        require_trials(plan(tmp_path, policies=pushed))
    swept = [{"name": "base", "source": "pi0", "steps": [1, 2]}]
    with pytest.raises(ConfigError, match=r"steps: .* name each checkpoint as a policy"):
        require_trials(plan(tmp_path, policies=swept))


def test_what_would_show_rates_before_the_end_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"track.*before the end"):
        require_trials(plan(tmp_path, track=["wandb"]))


def test_exact_images_are_refused_with_a_robot(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"record_images.*with a robot"):
        require_trials(plan(tmp_path, record_images="exact"))


def test_results_of_the_robot_are_not_those_of_its_simulation(tmp_path: Path) -> None:
    tasks = {"tabletop": {"instruction": "push"}}
    real, simulated = (
        plan_cases(
            plan(tmp_path, suite={"envs": ["tabletop"]}, robot={"arm": arm, "tasks": tasks})
        )[0]
        for arm in ("a:B", None)
    )
    assert real.fingerprint != simulated.fingerprint
    assert "robot" not in simulated.settings
    assert "key" not in real.settings["robot"]
