"""Gymnasium's VectorEnvs: each row plays the episode that it plays alone, whatever the VectorEnv does at its end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from vlagents_ray.envs import make_env
from vlagents_ray.envs.base import BatchEnv, make_batch
from vlagents_ray.envs.gymnasium.vector import GymnasiumBatch
from vlagents_ray.errors import ConfigError, InvalidAction, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.testing import check_env

pytestmark = pytest.mark.sim

SEEDS = [4, 0, 9]
MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]


class Drift(gymnasium.Env[dict[str, Any], np.ndarray]):
    """A point that noise moves; it is home, which is success, after 2 to 6 steps, as the seed has it."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        box = gymnasium.spaces.Box
        self.action_space = box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {"pixels": box(0, 255, (4, 6, 3), np.uint8), "at": box(-9, 9, (2,), np.float64)}
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.count, self.home = 0, int(self.np_random.integers(2, 7))
        self.at = self.np_random.uniform(-1, 1, 2) + (options or {}).get("by", 0.0)
        return self.seen(), {"home": self.home}

    def step(self, action: np.ndarray) -> Any:
        assert self.count < self.home, "stepped after its end"
        self.count += 1
        self.at = self.at + action + 0.1 * self.np_random.normal(size=2)
        home = self.count >= self.home
        return self.seen(), float(self.at[0]), home, False, {"is_success": home, "nested": {"count": self.count}}

    def seen(self) -> dict[str, Any]:
        return {"pixels": np.full((4, 6, 3), 10 * self.count, np.uint8), "at": self.at}

    def render(self) -> Any:
        return np.full((4, 6, 3), 100 + self.count, np.uint8)


def several(num_envs: int, mode: str = "NEXT_STEP", **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Drift(**kwargs)] * num_envs, autoreset_mode=AutoresetMode[mode])


def silent(num_envs: int, **_: Any) -> SyncVectorEnv:
    made = several(num_envs)
    made.metadata = {}
    return made


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Iterator[None]:
    gymnasium.register("Drift-v0", entry_point=Drift, max_episode_steps=5)
    gymnasium.register("Drifts-v0", vector_entry_point=several)
    gymnasium.register("Silent-v0", vector_entry_point=silent)
    yield
    for name in ("Drift-v0", "Drifts-v0", "Silent-v0"):
        gymnasium.registry.pop(name)


def actions(seed: int, count: int = 6) -> list[Act]:
    return [Act(row) for row in np.random.default_rng(seed).uniform(-1, 1, (count, 2)).astype(np.float32)]


def same(one: Obs, other: Obs) -> None:
    assert sorted(one.cameras) == sorted(other.cameras)
    for name, image in one.cameras.items():
        np.testing.assert_array_equal(image, other.cameras[name])
    np.testing.assert_array_equal(one.state["at"], other.state["at"])


def alone(seed: int, **options: Any) -> list[Any]:
    """The observations and outcomes of an episode that a single environment plays."""
    with make_env("gymnasium/Drift-v0", max_steps=5, **options) as env:
        found: list[Any] = [(env.reset(seed=seed)[0],)]
        for act in actions(seed):
            found.append(env.step(act))
            if found[-1][2] or found[-1][3]:
                return found
    raise AssertionError("the episode does not end")


def assert_played(batch: BatchEnv, seeds: list[int], **options: Any) -> None:
    expected = {i: alone(seed, **options) for i, seed in enumerate(seeds)}
    plans = [actions(seed) for seed in seeds]
    for obs, episode in zip(batch.reset(seeds=seeds), expected.values(), strict=True):
        same(obs, episode[0][0])
    for step in range(1, 6):
        going = [step < len(expected[i]) for i in range(len(seeds))]
        if not any(going):
            break
        seen, *outcomes = batch.step([plans[i][step - 1] if going[i] else None for i in range(len(seeds))])
        for i in np.flatnonzero(going):
            obs, *outcome = expected[i][step]
            same(seen[i], obs)
            assert [part[i] for part in outcomes] == outcome


@pytest.mark.parametrize("mode", MODES)
def test_each_row_plays_the_episode_that_it_plays_alone(mode: str) -> None:
    with make_batch("gymnasium/Drifts-v0", 3, kwargs={"mode": mode}, max_steps=5) as batch:
        assert isinstance(batch, GymnasiumBatch)
        assert batch.describe()["autoreset"] == mode
        assert batch.restarts is (mode == "DISABLED")
        assert_played(batch, SEEDS)
        assert_played(batch, [7, 4])  # fewer than rows, after episodes that ended at different steps
        assert_played(batch, SEEDS)


@pytest.mark.parametrize("how", ["sync", "async"])
def test_a_registered_env_is_vectorized_on_demand(how: str) -> None:
    with make_batch("gymnasium/Drift-v0", 3, vectorization=how, max_steps=5) as batch:
        assert isinstance(batch, GymnasiumBatch)
        assert batch.describe()["num_envs"] == 3
        assert_played(batch, SEEDS)


def test_a_vector_entry_with_discrete_actions_is_refused() -> None:
    with pytest.raises(ConfigError, match="Discrete"):
        make_batch("gymnasium/CartPole-v1", 2, vectorization="vector_entry_point")


@pytest.mark.parametrize("mode", MODES)
def test_one_row_is_an_environment(mode: str) -> None:
    check_env(make_env("gymnasium/Drifts-v0", kwargs={"mode": mode}, max_steps=5, record_size=(8, 8)))


def test_a_row_restarts_while_the_others_go_on_where_resets_are_the_callers() -> None:
    with make_batch("gymnasium/Drift-v0", 2, vectorization="sync", max_steps=5) as batch:
        begun = batch.reset(seeds=[4, 0])
        kept = batch.step([actions(4)[0], None])[0][0]
        same(batch.restart(1, seed=9), alone(9)[0][0])
        seen, *_ = batch.step([actions(4)[1], actions(9)[0]])
        same(seen[0], alone(4)[2][0])
        same(seen[1], alone(9)[1][0])
        same(kept, alone(4)[1][0])
        same(begun[0], alone(4)[0][0])
    with (
        make_batch("gymnasium/Drifts-v0", 2, max_steps=5) as batch,
        pytest.raises(ConfigError, match="resets its environments together"),
    ):
        batch.restart(0, seed=1)


def test_the_renderers_pictures_are_the_rows_own() -> None:
    options = {"cameras": {"shown": "render"}, "state": {"at": "at"}}
    with make_batch("gymnasium/Drift-v0", 3, vectorization="sync", max_steps=5, **options) as batch:
        assert_played(batch, SEEDS, **options)
        first = batch.reset(seeds=SEEDS)
        assert first[0].cameras["shown"].base is first[1].cameras["shown"].base
    wrong = {"mode": "SAME_STEP", "render_mode": "rgb_array"}
    with pytest.raises(ConfigError, match="last picture of its renderer"):
        make_batch("gymnasium/Drifts-v0", 2, kwargs=wrong, max_steps=5, **options)


def test_the_options_of_a_reset_are_the_same_in_each_row() -> None:
    with make_batch("gymnasium/Drift-v0", 2, vectorization="sync", max_steps=5) as batch:
        plain, moved = batch.reset(seeds=[3, 3]), batch.reset(seeds=[3, 3], options=[{"by": 2.0}] * 2)
        np.testing.assert_allclose(moved[1].state["at"] - plain[1].state["at"], 2.0, rtol=1e-6)
        with pytest.raises(ConfigError, match="differ"):
            batch.reset(seeds=[3, 3], options=[{"by": 2.0}, None])


def test_wrong_use_is_named() -> None:
    with make_batch("gymnasium/Drifts-v0", 2, max_steps=5) as batch:
        with pytest.raises(NotReset):
            batch.step([None, None])
        batch.reset(seeds=[1, 2])
        with pytest.raises(ConfigError, match="got 1 actions, want 2"):
            batch.step([None])
        with pytest.raises(InvalidAction):
            batch.step([Act(np.zeros(3, np.float32)), None])
        with pytest.raises(ConfigError, match="want 0 or more"):
            batch.reset(seeds=[-1, 2])
    batch.close()
    with pytest.raises(NotReset, match="closed"):
        batch.reset(seeds=[1, 2])


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("Drift-v0", {"vectorization": "threads"}, "want one of"),
        ("Drift-v0", {"vectorization": "vector_entry_point"}, "vector entry point"),
        ("Drifts-v0", {}, "step limit is None"),
        ("Drifts-v0", {"max_steps": 5, "remake": True}, "remake"),
        ("Silent-v0", {"max_steps": 5}, "autoreset_mode"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*missing AutoresetMode:UserWarning")
def test_what_cannot_be_a_batch_is_refused(name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_batch(f"gymnasium/{name}", 2, **options)
