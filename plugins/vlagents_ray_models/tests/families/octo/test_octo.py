"""Octo's own code, called through the policy: the same actions, in any batch."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jax_compiles import jax_compiles
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.octo.conftest import MARKS
from vlagents_ray import Act, Obs
from vlagents_ray.errors import InvalidObservation, MissingCamera
from vlagents_ray.interface import DISTRIBUTION, GOAL_IMAGE, SAMPLES
from vlagents_ray.testing import check_agent
from vlagents_ray_models.octo import Octo

pytestmark = MARKS

# float32 on a CPU, actions of up to 5; measured: 3e-5, as untrained weights amplify differences.
ATOL = 1e-4
INSTRUCTIONS = ["pick up the cube", "push the cube", "open the drawer"]


def made(checkpoint: Path, **config: Any) -> Octo:
    return Octo.from_config(
        {"checkpoint": str(checkpoint), "dataset": "bridge_dataset", "batch_sizes": None, **config}
    )


@pytest.fixture(scope="module")
def policy(pretrained: Path) -> Octo:
    loaded = made(pretrained, batch_sizes=[1, 8])
    loaded.initialize()
    return loaded


def seen(seed: int, size: tuple[int, int] = (48, 64), **info: Any) -> Obs:
    rng = np.random.default_rng(seed)
    cameras = {}
    for name in ("front", "wrist"):
        cameras[name] = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    return Obs(cameras=cameras, info=info)


def begun(policy: Octo, obs: Obs, instruction: str | None = "push the cube", seed: int = 0) -> Octo:
    session = copy.copy(policy)
    session.reset(obs, instruction, seed=seed)
    return session


def upstream(
    policy: Octo, frames: list[Obs], mask: list[bool], tasks: dict[str, Any], seed: int
) -> np.ndarray:
    """Return the result of Octo's `sample_actions` for one robot, with the key that a session of
    this seed draws first.
    """
    perceived = [policy.perceive(obs) for obs in frames]
    observations = {}
    for name in perceived[0]:
        observations[name] = np.stack([frame[name] for frame in perceived])[None]
    observations["timestep_pad_mask"] = np.array([mask])
    key = np.random.default_rng([0, seed]).integers(2**32, size=2, dtype=np.uint32)
    statistics = policy.model.statistics(policy.config.dataset, "action")
    actions = policy.model.model.sample_actions(
        observations, tasks, unnormalization_statistics=statistics, rng=key
    )
    return np.asarray(actions[0])


def test_keeps_the_contract(pretrained: Path) -> None:
    check_agent(made(pretrained, batch_sizes=[1, 4]), atol=ATOL)


@pytest.mark.verifies("parity")
def test_an_instruction_gives_what_octo_gives_and_only_real_frames_count(policy: Octo) -> None:
    first, second = seen(1), seen(2)
    tasks = policy.model.model.create_tasks(texts=["push the cube"])
    session = begun(policy, first, seed=5)
    expected = upstream(policy, [first, first], [False, True], tasks, seed=5)
    np.testing.assert_allclose(session.act(first).action, expected, atol=ATOL)

    later = begun(policy, first, seed=6)
    later.observe(first)
    expected = upstream(policy, [first, second], [True, True], tasks, seed=6)
    np.testing.assert_allclose(later.act(second).action, expected, atol=ATOL)


@pytest.mark.verifies("parity")
def test_a_goal_image_gives_what_octo_gives(policy: Octo) -> None:
    goal = seen(9).cameras["front"]
    obs = seen(1, **{GOAL_IMAGE: goal})
    resized_goal = policy.perceive(Obs(cameras={"front": goal, "wrist": goal}))["image_primary"]
    tasks = policy.model.model.create_tasks(goals={"image_primary": resized_goal[None]})
    expected = upstream(policy, [obs, obs], [False, True], tasks, 3)
    action = begun(policy, obs, None, seed=3).act(obs).action
    np.testing.assert_allclose(action, expected, atol=ATOL)


@pytest.mark.verifies("batches")
def test_a_session_gets_the_same_in_any_company(policy: Octo) -> None:
    goal = seen(90).cameras["front"]
    views = [seen(i, **({GOAL_IMAGE: goal} if i % 3 == 2 else {})) for i in range(8)]

    def sessions(count: int) -> list[Octo]:
        return [begun(policy, views[i], INSTRUCTIONS[i % 3], seed=i) for i in range(count)]

    alone = [session.act(view).action for session, view in zip(sessions(8), views, strict=True)]
    for size in (2, 3, 8):
        for i, act in enumerate(policy.act_batch(views[:size], sessions(size))):
            np.testing.assert_allclose(act.action, alone[i], atol=ATOL)
    assert np.ptp(np.stack(alone), axis=0).mean() > 100 * ATOL  # eight answers, not one


def test_samples_are_draws_of_their_own(policy: Octo) -> None:
    expected = begun(policy, seen(1)).act(seen(1)).action
    act = begun(policy, seen(1)).act(seen(1, **{SAMPLES: 10}))
    np.testing.assert_allclose(act.action, expected, atol=ATOL)

    distribution = act.info[DISTRIBUTION]
    assert distribution["samples"].shape == (10, 4, 7)
    assert distribution["std"].mean() > 100 * ATOL
    np.testing.assert_allclose(distribution["mean"], distribution["samples"].mean(0), atol=ATOL)


def test_a_camera_that_is_left_out_has_no_tokens_as_in_octo(pretrained: Path) -> None:
    policy = made(pretrained, cameras={"image_primary": "front"})
    policy.initialize()
    obs = Obs(cameras={"front": seen(1).cameras["front"]})
    tasks = policy.model.model.create_tasks(texts=["push the cube"])
    expected = upstream(policy, [obs, obs], [False, True], tasks, seed=0)
    np.testing.assert_allclose(begun(policy, obs).act(obs).action, expected, atol=ATOL)


def test_a_finetuned_checkpoint_reads_the_state(finetuned: Path) -> None:
    policy = made(finetuned, dataset=None, state=["joints"])
    policy.initialize()
    contract = policy.contract
    assert contract.state is not None
    assert contract.state["joints"].dim == 3
    assert list(contract.cameras or {}) == ["front"]

    obs = Obs(
        cameras={"front": seen(1).cameras["front"]},
        state={"joints": np.array([2, 1, -4], np.float32)},
    )
    np.testing.assert_allclose(policy.perceive(obs)["proprio"], [1, 0, -3], atol=1e-6)
    tasks = policy.model.model.create_tasks(texts=["push the cube"])
    expected = upstream(policy, [obs, obs], [False, True], tasks, seed=0)
    np.testing.assert_allclose(begun(policy, obs).act(obs).action, expected, atol=ATOL)


@pytest.mark.parametrize(
    ("goal", "instruction", "info"),
    [
        ("either", None, {}),
        ("image", "push the cube", {}),
        ("language", None, {}),
        ("language", "push the cube", {GOAL_IMAGE: np.zeros((8, 8, 3), np.uint8)}),
        ("either", None, {GOAL_IMAGE: np.zeros((8, 8), np.uint8)}),
    ],
)
def test_an_episode_without_its_kind_of_task_is_refused(
    policy: Octo, pretrained: Path, goal: str, instruction: str | None, info: dict[str, Any]
) -> None:
    other = made(pretrained, goal=goal)
    other.model = policy.model
    with pytest.raises(InvalidObservation, match="expected"):
        other.reset(seen(1, **info), instruction)


@pytest.mark.verifies("isolation")
def test_a_missing_camera_fails_its_own_session_alone(policy: Octo) -> None:
    blind = Obs(cameras={"front": np.zeros((8, 8, 3), np.uint8)})
    bad, good = policy.act_batch([blind, seen(1)], [begun(policy, seen(0)), begun(policy, seen(1))])
    assert isinstance(bad, MissingCamera)
    assert not isinstance(good, Exception)


def test_no_act_compiles_a_program(pretrained: Path) -> None:
    policy = made(pretrained, batch_sizes=[1, 2, 4])
    policy.initialize()
    batches: list[list[dict[str, Any]]] = [[{}] * count for count in range(1, 7)]
    for samples in (1, 2, 3, 5):
        batches += [[{SAMPLES: samples}, *[{}] * neighbours] for neighbours in range(3)]
    with jax_compiles() as compiled:
        for batch in batches:
            views = [seen(i, **info) for i, info in enumerate(batch)]
            sessions = [begun(policy, view, seed=i) for i, view in enumerate(views)]
            acts = policy.act_batch(views, sessions)
            assert all(isinstance(act, Act) for act in acts)
    assert compiled == []


def test_it_acts_with_pushed_weights(pretrained: Path) -> None:
    from flax.traverse_util import flatten_dict

    policy = made(pretrained, batch_sizes=[1])
    policy.initialize()
    # The names are those of OctoModel.
    assert policy.parameters().keys() == flatten_dict(policy.model.model.params, sep="/").keys()
    obs = seen(1)
    check_pushed_weights(policy, lambda: begun(policy, obs).act(obs).action)
