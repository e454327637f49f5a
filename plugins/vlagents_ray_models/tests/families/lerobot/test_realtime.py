"""Real-time chunking: a new chunk continues the plan of its robot, independently of other
robots.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.rtc import configuration_rtc

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER
from vlagents_ray_models.lerobot import LeRobot, checkpoint
from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.samplers import LONGEST_PREFIX, SmolVLAPasses

pytestmark = FILTERS


@pytest.mark.verifies("isolation")
def test_a_leftover_of_another_robot_fails_its_own_session_alone(loaded: Load) -> None:
    policy = loaded("smolvla")
    bad = view(**{LEFTOVER: np.zeros((3, tiny.ACTION + 1), np.float32)})
    wrong, right = policy.act_batch([bad, view(1)], [begun(policy), begun(policy, 1)])
    assert isinstance(wrong, InvalidObservation)
    assert not isinstance(right, Exception)


@pytest.mark.verifies("isolation")
def test_leftovers_and_delays_of_neighbours_do_not_matter(loaded: Load) -> None:
    policy = loaded("smolvla", execute=tiny.CHUNK)
    plan = np.linspace(-1, 1, 5 * tiny.ACTION, dtype=np.float32).reshape(5, tiny.ACTION)
    views = [
        view(0, **{LEFTOVER: plan, DELAY: 2}),
        view(1),
        view(2, **{LEFTOVER: plan[:3], DELAY: 1}),
        view(3, **{LEFTOVER: plan[:0], DELAY: 3}),
        view(4, **{LEFTOVER: np.tile(plan, (4, 1)), DELAY: 0}),
    ]
    alone = [begun(policy, i).act(obs).action for i, obs in enumerate(views)]
    acts = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    for act, expected in zip(acts, alone, strict=True):
        assert not isinstance(act, Exception)
        np.testing.assert_allclose(act.action, expected, atol=1e-5)


def test_a_chunk_continues_the_plan_of_the_robot(loaded: Load) -> None:
    policy = loaded("smolvla", execute=tiny.CHUNK)
    plan = begun(policy, 5).act(view(5)).action[2:]
    free = begun(policy).act(view()).action
    guided = begun(policy).act(view(**{LEFTOVER: plan, DELAY: 3})).action
    assert np.abs(guided[:3] - plan[:3]).max() < 0.2 * np.abs(free[:3] - plan[:3]).max()


@pytest.mark.parametrize("kind", ["smolvla"])
def test_without_a_delay_actions_are_bit_identical_to_those_without_a_plan(
    kind: str, loaded: Load
) -> None:
    policy = loaded(kind, execute=tiny.CHUNK)
    plan = begun(policy, 5).act(view(5)).action
    free, unguided = (
        begun(policy).act(view(**info)).action for info in ({}, {LEFTOVER: plan, DELAY: 0})
    )
    np.testing.assert_array_equal(free, unguided)


def test_the_settings_of_the_guidance_can_be_overridden(made: Made) -> None:
    settings = {
        "execution_horizon": 4,
        "max_guidance_weight": 2.0,
        "prefix_attention_schedule": "EXP",
    }
    policy = LeRobot.from_config(
        {"checkpoint": str(made("smolvla")), "overrides": {"rtc_config": settings}}
    )
    policy.initialize()
    assert policy.continues_plans
    used = policy.model.sampler.policy.rtc_processor.rtc_config
    assert (used.execution_horizon, used.max_guidance_weight) == (4, 2.0)
    assert used.prefix_attention_schedule.name == "EXP"


def test_policies_of_single_actions_do_not_continue_plans(loaded: Load) -> None:
    assert not loaded("smolvla", actions="queue").continues_plans
    assert not loaded("act").continues_plans


LONGEST = 3  # rows of a prefix
STEP = 0.1  # what the network below adds in each row after the prefix


def _continue(self: Any, constants: Any, actions: Any, times: Any) -> Any:
    """Return the velocity of a network that continues from the last row at time 0.

    Neither LeRobot 0.4.4 nor 0.6.1 has such a network.
    """
    in_prefix = times == 0
    last = in_prefix.sum(1) - 1
    start = actions[torch.arange(len(actions)), last.clamp(min=0)] * (last >= 0)[:, None]
    rows_after = torch.arange(actions.shape[1])[None, :, None] - last[:, None, None]
    return (actions - start[:, None] - STEP * rows_after) / times.clamp(min=1e-6)[..., None]


@pytest.fixture
def prefixed(made: Made, monkeypatch: pytest.MonkeyPatch) -> LeRobot:
    """A policy whose config has prefixes, as a checkpoint of a LeRobot after 0.6.1."""

    @dataclasses.dataclass
    class Config(configuration_rtc.RTCConfig):  # type: ignore[misc]
        mode: str = "guided"

    read_settings = checkpoint._read_settings

    def read_with_prefixes(folder: Path, config: LeRobotConfig) -> Any:
        settings = read_settings(folder, config)
        setattr(settings, LONGEST_PREFIX, LONGEST)
        return settings

    monkeypatch.setattr(checkpoint, "_read_settings", read_with_prefixes)
    monkeypatch.setattr(configuration_rtc, "RTCConfig", Config)
    monkeypatch.setattr(SmolVLAPasses, "velocity", _continue)
    policy = LeRobot.from_config({"checkpoint": str(made("smolvla")), "execute": tiny.CHUNK})
    policy.initialize()
    return policy


def test_a_checkpoint_trained_with_prefixes_continues_them(prefixed: LeRobot) -> None:
    plan = np.random.default_rng(5).uniform(-1, 1, (6, tiny.ACTION)).astype(np.float32)
    prefix_rows = {0: 0, 2: 2, 5: LONGEST}  # by the delay
    views = [view(0, **{LEFTOVER: plan, DELAY: delay}) for delay in prefix_rows]
    acts = prefixed.act_batch([*views, view(0)], [begun(prefixed, i) for i in range(4)])
    scale = tiny.statistics()["action"]["std"]
    for act, rows in zip(acts, [*prefix_rows.values(), 0], strict=True):
        assert not isinstance(act, Exception)
        assert act.info.get(GIVEN, 0) == rows
        np.testing.assert_allclose(act.action[:rows], plan[:rows], atol=1e-5)
        steps = np.diff(act.action[max(rows - 1, 0) :], axis=0) / scale
        np.testing.assert_allclose(steps, STEP, atol=1e-4)
