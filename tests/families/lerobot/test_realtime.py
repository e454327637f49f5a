"""Real-time chunking: new chunks go on from what each robot is doing, whatever its neighbours do."""

from __future__ import annotations

import numpy as np
import pytest

from tests.families.lerobot import tiny
from tests.families.lerobot.conftest import FILTERS, Load, Made, begun, view
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.policies.lerobot import LeRobot

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
    alone = [begun(policy, i).act(one).action for i, one in enumerate(views)]
    acts = policy.act_batch(views, [begun(policy, i) for i in range(len(views))])
    for act, wanted in zip(acts, alone, strict=True):
        assert not isinstance(act, Exception)
        np.testing.assert_allclose(act.action, wanted, atol=1e-5)


def test_a_chunk_goes_on_from_what_the_robot_is_doing(loaded: Load) -> None:
    policy = loaded("smolvla", execute=tiny.CHUNK)
    plan = begun(policy, 5).act(view(5)).action[2:]
    free = begun(policy).act(view()).action
    guided = begun(policy).act(view(**{LEFTOVER: plan, DELAY: 3})).action
    assert np.abs(guided[:3] - plan[:3]).max() < 0.2 * np.abs(free[:3] - plan[:3]).max()


def test_the_settings_of_the_guidance_can_be_overridden(made: Made) -> None:
    settings = {"execution_horizon": 4, "max_guidance_weight": 2.0, "prefix_attention_schedule": "EXP"}
    policy = LeRobot.from_config({"checkpoint": str(made("smolvla")), "overrides": {"rtc_config": settings}})
    policy.initialize()
    assert policy.continues_plans
    used = policy.model.kind.policy.rtc_processor.rtc_config
    assert (used.execution_horizon, used.max_guidance_weight) == (4, 2.0)
    assert used.prefix_attention_schedule.name == "EXP"


def test_single_actions_do_not_go_on_from_a_plan(loaded: Load) -> None:
    assert not loaded("smolvla", actions="queue").continues_plans
    assert not loaded("act").continues_plans
