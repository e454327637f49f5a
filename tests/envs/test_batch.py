"""Environments that step together behave as if each were alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vlagents_ray.envs import make_env
from vlagents_ray.envs.base import BatchEnv, SequentialBatch, make_batch
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import Act, Obs

SEEDS = [3, 11, 5]
SIZE = {"width": 40, "height": 32}


@pytest.fixture
def batch() -> BatchEnv:
    return make_batch("tabletop/lift", 3, **SIZE)


def actions(seed: int, count: int = 6) -> list[Act]:
    drawn = np.random.default_rng(seed).uniform(-1, 1, (count, 4)).astype(np.float32)
    return [Act(row) for row in drawn]


def assert_same(one: Obs, other: Obs) -> None:
    np.testing.assert_array_equal(one.cameras["front"], other.cameras["front"])
    np.testing.assert_array_equal(one.state["xyzrpy"], other.state["xyzrpy"])
    assert one.gripper == other.gripper


def test_each_episode_is_the_one_that_is_played_alone(batch: BatchEnv) -> None:
    plans = [actions(seed) for seed in SEEDS]
    together = [batch.reset(seeds=SEEDS)]
    outcomes = []
    for acts in zip(*plans, strict=True):
        seen, *rest = batch.step(acts)
        together.append(seen)
        outcomes.append(list(zip(*rest, strict=True)))
    for i, seed in enumerate(SEEDS):
        with make_env("tabletop/lift", **SIZE) as alone:
            assert_same(together[0][i], alone.reset(seed=seed)[0])
            assert batch.instructions[i] == alone.instruction
            for step, act in enumerate(plans[i]):
                obs, *outcome = alone.step(act)
                assert_same(together[step + 1][i], obs)
                assert outcomes[step][i] == tuple(outcome)


def test_a_cameras_images_are_rows_of_one_array(batch: BatchEnv) -> None:
    seen = batch.reset(seeds=SEEDS)
    arrays = {id(obs.cameras["front"].base) for obs in seen}
    assert len(arrays) == 1
    assert seen[0].cameras["front"].base.shape == (3, 32, 40, 3)
    later, *_ = batch.step([act[0] for act in (actions(0), actions(1), actions(2))])
    # Earlier observations stay unchanged.
    assert later[0].cameras["front"].base is not seen[0].cameras["front"].base


def test_an_idle_environment_stands_still_while_the_others_go_on(batch: BatchEnv) -> None:
    first = batch.reset(seeds=SEEDS)
    for act in actions(0):
        seen, *_ = batch.step([act, None, act])
    assert_same(seen[1], first[1])
    assert not np.array_equal(seen[0].state["xyzrpy"], first[0].state["xyzrpy"])


def test_fewer_episodes_than_environments_leave_the_others_out(batch: BatchEnv) -> None:
    assert len(batch.reset(seeds=[7])) == len(batch.instructions) == 1
    seen, rewards, terminated, truncated, infos = batch.step([actions(0)[0]])
    assert [len(rows) for rows in (seen, rewards, terminated, truncated, infos)] == [1] * 5
    assert len(batch.reset(seeds=SEEDS)) == 3


def test_each_environment_has_options_of_its_own(batch: BatchEnv) -> None:
    with make_env("tabletop/lift", **SIZE) as alone:
        possible = [alone.reset(seed=seed)[1]["instructions"] for seed in SEEDS]
    options: list[dict[str, Any] | None] = [
        None,
        {"instruction": possible[1][0]},
        {"instruction": possible[2][-1]},
    ]
    batch.reset(seeds=SEEDS, options=options)
    assert batch.instructions[1:] == [possible[1][0], possible[2][-1]]


def test_an_unusable_action_is_refused_before_any_environment_moves(batch: BatchEnv) -> None:
    first = batch.reset(seeds=SEEDS)
    good = actions(0)[0]
    with pytest.raises(InvalidAction):
        batch.step([good, Act(np.zeros(3, np.float32)), good])
    seen, *_ = batch.step([None] * 3)
    for now, before in zip(seen, first, strict=True):
        assert_same(now, before)


def test_seeds_need_an_environment_each(batch: BatchEnv) -> None:
    for seeds in ([], [1, 2, 3, 4]):
        with pytest.raises(ConfigError, match="expected 1 to 3 seeds"):
            batch.reset(seeds=seeds)
    with pytest.raises(ConfigError, match="num_envs: expected a number of at least 1, got 0"):
        make_batch("tabletop", 0)
    with pytest.raises(ConfigError, match="it accepts"):
        make_batch("tabletop", 2, colour="red")


def test_a_batch_says_what_its_environments_say(batch: BatchEnv) -> None:
    with Tabletop("lift", **SIZE) as alone:
        assert batch.contract == alone.contract
        assert (batch.num_envs, batch.max_steps, batch.init_states) == (3, alone.max_steps, None)
        assert batch.describe() == {**alone.describe(), "num_envs": 3}


def test_closing_reaches_every_environment_even_after_one_that_fails() -> None:
    class Stubborn(Tabletop):
        def close(self) -> None:
            raise RuntimeError("not yet")

    last = Tabletop("lift", **SIZE)
    last.reset(seed=0)
    with pytest.raises(RuntimeError, match="not yet"):
        SequentialBatch([last, Stubborn("lift", **SIZE)]).close()
    assert last._world is None
