"""The planner's mathematics, on a world where features are the pose that they belong to."""

from __future__ import annotations

import copy
import pickle
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.staging import Staging
from vlagents_ray_models.vjepa2_ac import DRAWN, Goal, VJepa2Ac, VJepa2AcConfig, moved, plan

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.torch


def config(**settings: Any) -> VJepa2AcConfig:
    return VJepa2AcConfig(checkpoint="none", **settings)


def noise(settings: VJepa2AcConfig, *seeds: int) -> torch.Tensor:
    shape = (settings.iterations, settings.rollout, settings.samples, DRAWN)
    return torch.stack(
        [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    )


def world(features: torch.Tensor, actions: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
    """Return the features of the next frame, according to the last action."""
    assert features.shape[1] == actions.shape[1] == poses.shape[1]
    return features_at(moved(poses[:, -1], actions[:, -1]))


def features_at(poses: torch.Tensor) -> torch.Tensor:
    """Return the features of images at poses, one token each: position and closedness."""
    return poses[:, None, [0, 1, 2, 6]]


def poses_at(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows)


def test_poses_move_and_keep_their_rotation() -> None:
    rng = np.random.default_rng(0)
    poses, actions = (rng.uniform(-3, 3, (200, 7)) for _ in range(2))
    after = moved(torch.tensor(poses), torch.tensor(actions)).numpy()
    assert np.array_equal(after[:, 3:6], poses[:, 3:6])
    assert np.allclose(after[:, :3], (poses + actions)[:, :3])
    assert np.allclose(after[:, 6], np.clip(poses[:, 6] + actions[:, 6], 0, 1))


def test_a_plan_goes_where_the_goal_is() -> None:
    settings = config(iterations=20, maxnorm=0.05)
    start = poses_at([0.3, 0.0, 0.4, 3.1, 0.0, 0.0, 0.0], [0.3, 0.0, 0.4, 3.1, 0.0, 0.0, 1.0])
    goal = poses_at([0.36, -0.03, 0.4, 3.1, 0.0, 0.0, 1.0], [0.25, 0.08, 0.42, 3.1, 0.0, 0.0, 1.0])
    plans = plan(
        world, features_at(start), start, features_at(goal), noise(settings, 0, 1), settings
    )
    assert plans.actions.shape == plans.std.shape == (2, settings.rollout, 7)
    assert torch.allclose(plans.actions[..., :3].sum(1), (goal - start)[:, :3], atol=0.01)
    assert plans.actions[0, :, 6].sum() >= 0.9  # closes
    assert plans.actions[..., :3].abs().max() <= settings.maxnorm
    assert not plans.actions[..., 3:6].any()
    assert plans.energy.max() < 0.01


def test_a_session_gets_the_same_plan_in_any_company_and_in_passes_of_any_size() -> None:
    settings = config(samples=50)
    start = poses_at(*([0.1 * i, 0.0, 0.4, 3.1, 0.2, 0.0, 0.5] for i in range(3)))
    goal = start + 0.04
    together = plan(
        world, features_at(start), start, features_at(goal), noise(settings, 0, 1, 2), settings
    )
    small = config(samples=50, pass_size=7)
    for i in range(3):
        start_pose, goal_pose = start[i : i + 1], goal[i : i + 1]
        alone = plan(
            world,
            features_at(start_pose),
            start_pose,
            features_at(goal_pose),
            noise(settings, i),
            small,
        )
        assert torch.allclose(alone.actions[0], together.actions[i], atol=1e-6)
        assert torch.allclose(alone.energy[0], together.energy[i], atol=1e-6)


def test_small_changes_of_the_gripper_are_none() -> None:
    settings = config(iterations=20, rollout=1)
    start = poses_at([0.3, 0.0, 0.4, 3.1, 0.0, 0.0, 0.5])
    plans = plan(world, features_at(start), start, features_at(start), noise(settings, 0), settings)
    assert not plans.actions[..., 6].any()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"topk": 500}, "topk: expected a small part of the 400 samples, got 500"),
        ({"cameras": {"front": "front", "wrist": "wrist"}}, "cameras: expected"),
        ({"cem_steps": 5}, "cem_steps"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=f"(?s){says}"):
        VJepa2Ac.from_config({"checkpoint": "none", **settings})


class PoseWorld:
    """A world model whose images are poses."""

    def __init__(self) -> None:
        self.encoded = 0  # images
        self.staging = Staging("cpu")

    def autocast(self) -> Any:
        return nullcontext()

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        self.encoded += len(images)
        return features_at(images)

    def __call__(self, *inputs: torch.Tensor) -> torch.Tensor:
        return world(*inputs)


def test_the_features_of_a_goal_move_without_its_device_and_are_not_computed_again() -> None:
    policy = VJepa2Ac(config(samples=20, iterations=2))
    policy.model = network = PoseWorld()
    start = np.array([0.3, 0.0, 0.4, 3.1, 0.0, 0.0, 0.5], np.float32)
    row = Row(
        (network.staging.stage({"pixels": start, "pose": start}),),
        "",
        np.random.default_rng(0),
        memory={"goal": Goal(start + np.float32(0.04))},
    )
    samples = []
    for seed in (1, 2):
        memory = copy.deepcopy(row.memory)
        samples.append(Row(row.frames, "", np.random.default_rng(seed), memory=memory))
    policy._plans([row, *samples])
    assert network.encoded == 3 + 1  # the images of three rows, and one goal

    pickled = pickle.dumps(row.memory)
    assert b"torch" not in pickled, "a tensor of a GPU can only be unpickled where the same GPU is"
    moved_memory = pickle.loads(pickled)  # noqa: S301 - the test wrote it
    np.testing.assert_array_equal(moved_memory["goal"].features, row.memory["goal"].features)

    def planned(memory: dict[str, Any]) -> np.ndarray:
        [prediction] = policy._plans([Row(row.frames, "", np.random.default_rng(5), memory=memory)])
        return prediction.actions

    np.testing.assert_array_equal(planned(moved_memory), planned(row.memory))
    assert network.encoded == 4 + 2
    assert isinstance(moved_memory["goal"].features, torch.Tensor), (
        "once it is on the device, it stays there"
    )
    assert b"torch" not in pickle.dumps(moved_memory)
