"""Tests of every type of LeRobot policy: its contract, and the independence of sessions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from batch_bits import differing_acts, invariant
from pushed_weights import check_pushed_weights
from shared_readings import check_shared_readings

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    TASKS,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray import Obs
from vlagents_ray.contract import CameraSpec, StateSpec
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.testing import check_agent
from vlagents_ray_models.lerobot import LeRobot, samplers

pytestmark = FILTERS

ATOL = 1e-5
INSTRUCTED = ("smolvla", "xvla", *(("vla_jepa", "eo1", "evo1", "wall_x") if tiny.NEW else ()))


@pytest.mark.parametrize("kind", sorted(tiny.KINDS))
def test_keeps_the_contract(kind: str, made: Made) -> None:
    check_agent(LeRobot.from_config({"checkpoint": str(made(kind))}), instructions=TASKS, atol=ATOL)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", sorted(tiny.KINDS))
def test_a_session_gets_the_same_in_any_company(kind: str, loaded: Load) -> None:
    policy = loaded(kind)
    alone = begun(policy, 1)
    first, second = alone.act(view(1)).action, alone.act(view(11)).action
    for size in (2, 3, 8):
        company = [begun(policy, number) for number in range(1, size + 1)]
        for tick, expected in enumerate((first, second)):
            acts = policy.act_batch(
                [view(10 * tick + number) for number in range(1, size + 1)], company
            )
            assert isinstance(acts[0], Act)
            np.testing.assert_allclose(acts[0].action, expected, atol=ATOL)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("kind", sorted(tiny.KINDS))
def test_no_bit_depends_on_the_batch_where_passes_have_one_size(kind: str, made: Made) -> None:
    with invariant(16) as report:
        policy = LeRobot.from_config({"checkpoint": str(made(kind))})
        policy.initialize()
    if report.variation is not None:  # a server rejects this policy
        assert report.variation == policy.variation
        return

    compared, differing = differing_acts(
        policy,
        lambda robot: begun(policy, robot),
        lambda robot, tick: view(100 * tick + robot),
        ticks=2,
        rounds=2,
    )
    assert compared == 2 * 2 * 11
    assert differing == []


@pytest.mark.parametrize("kind", INSTRUCTED)
def test_the_instruction_decides(kind: str, loaded: Load) -> None:
    policy = loaded(kind)
    chunks = []
    for task in TASKS[:2]:
        session = begun(policy)
        session.reset(view(), task, seed=0)
        chunks.append(session.act(view()).action)
    assert not np.allclose(*chunks, atol=1e-4)


def test_the_samples_of_an_observation_of_x_vla_are_of_one_reading_of_it(
    loaded: Load, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = loaded("xvla")
    vlm = policy.model.sampler.policy.model.vlm
    name = "get_image_features" if tiny.NEW else "_encode_image"
    encode = getattr(vlm, name)
    read: list[int] = []

    def count_and_encode(images: Any) -> Any:
        read.append(len(images))  # one camera
        return encode(images)

    monkeypatch.setattr(vlm, name, count_and_encode)
    views = [view(0, **{SAMPLES: 8}), view(1), view(2, **{SAMPLES: 3})]
    check_shared_readings(policy, views, begun, samplers, ATOL)
    assert read == [3, 14]


def test_a_policy_that_reads_no_instruction_does_without(loaded: Load) -> None:
    assert loaded("act").contract.instruction is None
    assert all(loaded(kind).contract.instruction for kind in INSTRUCTED)
    with pytest.raises(InvalidObservation, match="instruction"):
        begun(loaded("smolvla")).reset(view(), None)


def test_the_contract_is_what_the_checkpoint_was_trained_with(loaded: Load) -> None:
    contract = loaded("diffusion").contract
    assert contract.cameras == {tiny.CAMERA: CameraSpec(tiny.SIDE, tiny.SIDE)}
    assert contract.state == {"joints": StateSpec(tiny.STATE)}
    # A queue, for its history.
    assert (contract.action.dim, contract.chunk, contract.history) == (tiny.ACTION, 1, 2)
    assert loaded("diffusion", actions="chunk").contract.chunk == tiny.EXECUTED
    # It resizes any image itself.
    assert loaded("smolvla").contract.cameras == {tiny.CAMERA: CameraSpec()}


def test_the_ranges_of_the_training_are_stated(loaded: Load) -> None:
    ranges, expected = loaded("act").statistics, tiny.statistics()
    assert ranges is not None
    assert ranges["parts"] == ["joints"]
    for key in ("observation.state", "action"):
        assert set(ranges[key]) == {"min", "max"}
        np.testing.assert_allclose(ranges[key]["min"], expected[key]["min"], rtol=1e-6)


def test_the_names_of_the_joints_are_those_of_the_training(
    loaded: Load, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, names = loaded("act"), [f"joint{number}.pos" for number in range(tiny.ACTION)]
    model = policy.model
    # As LeRobot 0.6 saves it.
    monkeypatch.setattr(model.sampler.config, "action_feature_names", names, raising=False)
    described = policy._describe(model.sampler, model.processors, model.trained)
    assert described.contract.action.names == tuple(names)
    assert policy.contract.action.names is None


def test_images_of_any_size_meet_in_a_batch_of_a_policy_that_resizes(loaded: Load) -> None:
    policy = loaded("smolvla")
    sides = [64, 96, 64]
    views = [view(number, side) for number, side in enumerate(sides)]
    alone = [begun(policy, number).act(obs).action for number, obs in enumerate(views)]
    acts = policy.act_batch(views, [begun(policy, number) for number in range(3)])
    for act, expected in zip(acts, alone, strict=True):
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, expected, atol=ATOL)


def test_an_ensemble_and_its_coefficient_are_the_checkpoints_defaults(loaded: Load) -> None:
    policy = loaded("ensemble")
    assert policy.config.actions == "ensemble"
    assert policy.config.ensemble_m == 0.1
    assert policy.contract.chunk == 1
    assert loaded("ensemble", actions="chunk").contract.chunk == tiny.CHUNK
    assert loaded("act", actions="ensemble").config.execute is None


@pytest.mark.parametrize("kind", ["diffusion", "tdmpc", "smolvla"])
def test_samples_change_no_action_of_the_session(kind: str, loaded: Load) -> None:
    plain, sampling = begun(loaded(kind, actions="chunk")), begun(loaded(kind, actions="chunk"))
    for tick in range(2):
        act = sampling.act(view(tick, **{SAMPLES: 3}))
        assert act.info[DISTRIBUTION]["samples"].shape == (3, *act.action.shape)
        assert act.info[DISTRIBUTION]["std"].max() > 1e-3
        np.testing.assert_allclose(act.action, plain.act(view(tick)).action, atol=ATOL)


def test_other_names_for_cameras_and_state(loaded: Load, made: Made) -> None:
    policy = LeRobot.from_config(
        {
            "checkpoint": str(made("act")),
            "cameras": {tiny.CAMERA: "front"},
            "state": ["left/joints", "gripper"],
        }
    )
    policy.initialize()
    plain = view()
    plain.state["joints"][-1] = 0.5
    renamed = Obs(
        {"front": plain.cameras[tiny.CAMERA]}, 0.5, {"left/joints": plain.state["joints"][:-1]}
    )
    session = begun(loaded("act"))
    policy.reset(renamed, "go")
    np.testing.assert_array_equal(policy.act(renamed).action, session.act(plain).action)


@pytest.mark.parametrize("kind", sorted(tiny.KINDS))
def test_acts_with_pushed_weights(kind: str, made: Made) -> None:
    policy = LeRobot.from_config({"checkpoint": str(made(kind))})
    policy.initialize()
    # LeRobot's training uses the same names.
    assert policy.parameters().keys() == policy.model.sampler.policy.state_dict().keys()
    check_pushed_weights(policy, lambda: begun(policy, 1).act(view(1)).action)
