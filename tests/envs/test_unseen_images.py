"""Simulators render only the images that the policy receives, and no other part of an evaluation
depends on them.
"""

from __future__ import annotations

from typing import Any

import pytest
from unseen_images import require_same_without_unseen_images

from vlagents_ray.envs import make_env

SMALL = {"width": 32, "height": 32}


def played(name: str, **options: Any) -> None:
    with make_env(name, max_steps=9, **options) as env:
        require_same_without_unseen_images(env)


def test_the_tabletop() -> None:
    played("tabletop/lift", **SMALL)


@pytest.mark.sim
@pytest.mark.integration
def test_metaworld() -> None:
    played("metaworld/drawer-open-v3", **SMALL)


@pytest.mark.vulkan
@pytest.mark.parametrize("task", ["PickCube-v1", "StackCube-v1", "PushT-v1"])
def test_maniskill(task: str) -> None:
    """PickCube hides its goal from cameras, StackCube has two cameras, and PushT computes its
    reward from an image.
    """
    played(f"maniskill/{task}", **SMALL)


@pytest.mark.vulkan
@pytest.mark.assets("simpler")
def test_simpler() -> None:
    """Its state consists of poses, and its image is composed of a rendered image and a
    segmentation.
    """
    played("simpler/PutCarrotOnPlateInScene-v1")


@pytest.mark.vulkan
def test_a_simulator_that_runs_its_environments_together() -> None:
    from vlagents_ray.envs.maniskill import ManiSkillBatch
    from vlagents_ray.interface import Act

    with ManiSkillBatch("PickCube-v1", num_envs=1, sim_backend="physx_cpu", **SMALL) as batch:
        seen = {}
        for looked_at in (True, False):
            [obs] = batch.reset(seeds=[4])
            batch.looked_at = looked_at
            action = Act(obs.info["sim_state"][:7].clip(-1, 1))
            [obs], rewards, *_ = batch.step([action])
            seen[looked_at] = obs.info["sim_state"].tobytes(), rewards, set(obs.cameras)
    assert seen[True][:2] == seen[False][:2]
    assert (seen[True][2], seen[False][2]) == ({"base_camera"}, set())
