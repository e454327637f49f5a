"""π0 of transformers, on a small random checkpoint made with transformers itself."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from batch_bits import differing_acts, invariant
from safetensors.torch import load_file, save_file

from plugins.vlagents_ray_models.tests.families.pi0 import tiny
from plugins.vlagents_ray_models.tests.families.pi0.conftest import (
    BATCHED,
    WORDS,
    begun,
    made,
    seen,
)
from vlagents_ray import Obs
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera, NotTrainable
from vlagents_ray.interface import DELAY, LEFTOVER, SAMPLES
from vlagents_ray.testing import check_agent
from vlagents_ray_models.pi0 import Pi0


@pytest.fixture(scope="module")
def loaded(folder: Path) -> Pi0:
    return made(folder)


@pytest.fixture
def whole(folder: Path, tmp_path: Path) -> Path:
    """A copy of the checkpoint, to be damaged."""
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_it_keeps_what_an_agent_promises(folder: Path) -> None:
    views = [seen(0, (64, 64)), seen(1, (120, 60)), seen(2)]
    check_agent(Pi0.from_config({"checkpoint": str(folder)}), obs=views, instructions=WORDS)


def test_it_states_what_it_needs_and_gives(loaded: Pi0) -> None:
    contract = loaded.contract
    assert set(contract.cameras or ()) == {"front", "wrist"}
    assert set(contract.state or ()) == {"xyz_axis_angle", "gripper_qpos"}
    assert (contract.action.dim, contract.chunk, contract.instruction) == (
        tiny.ACTION_DIM,
        tiny.CHUNK,
        True,
    )


@pytest.mark.verifies("parity")
def test_actions_are_those_of_transformers_own_sampling(loaded: Pi0) -> None:
    session = begun(loaded, 0)
    obs = seen(0)
    noise = np.random.default_rng([0, 0]).standard_normal((1, tiny.CHUNK, 32), dtype=np.float32)
    network, processor = loaded.model.network, loaded.model.processor
    inputs = processor(
        images=[[obs.cameras["front"], obs.cameras["wrist"]]],
        text=[WORDS[0]],
        state=np.concatenate([obs.state["xyz_axis_angle"], obs.state["gripper_qpos"]])[None],
        padding=False,
    )
    flow = network.sample_actions(**inputs, noise=torch.from_numpy(noise))[
        0, :, : tiny.ACTION_DIM
    ].numpy()
    mean, std = np.array(processor.actions_mean), np.array(processor.actions_std)
    np.testing.assert_allclose(session.act(obs).action, flow * (std + 1e-8) + mean, atol=1e-5)


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("size", [2, 3, 8])
def test_neighbours_change_nothing(loaded: Pi0, size: int) -> None:
    alone = [begun(loaded, i).act(seen(i)).action for i in range(size)]
    batch = loaded.act_batch(
        [seen(i) for i in range(size)], [begun(loaded, i) for i in range(size)]
    )
    for action, act in zip(alone, batch, strict=True):
        np.testing.assert_allclose(act.action, action, atol=BATCHED)


def test_state_images_and_instruction_all_matter(loaded: Pi0) -> None:
    def acted(words: str, obs: Obs) -> np.ndarray:
        session = copy.copy(loaded)
        session.reset(obs, words, seed=0)
        return session.act(obs).action

    base, other = seen(0), seen(1)
    changed = [
        acted("push", base),
        acted(WORDS[0], Obs(base.cameras, state=other.state)),
        acted(WORDS[0], Obs({**base.cameras, "wrist": other.cameras["wrist"]}, state=base.state)),
    ]
    for actions in changed:
        assert np.abs(actions - acted(WORDS[0], base)).max() > 100 * BATCHED


def test_cameras_are_in_the_models_order_however_they_are_listed(folder: Path, loaded: Pi0) -> None:
    turned = Pi0.from_config(
        {"checkpoint": str(folder), "cameras": {"left_wrist_0_rgb": "wrist", "base_0_rgb": "front"}}
    )
    turned.model = loaded.model
    np.testing.assert_array_equal(
        begun(turned, 0).act(seen(0)).action, begun(loaded, 0).act(seen(0)).action
    )


def test_chunks_follow_the_plan(loaded: Pi0) -> None:
    plan = begun(loaded, 1).act(seen(1)).action[2:]
    free = begun(loaded, 0).act(seen(0)).action
    guided = begun(loaded, 0).act(seen(0, **{LEFTOVER: plan, DELAY: 3})).action
    off, without = (
        np.abs(guided[: len(plan)] - plan).mean(1),
        np.abs(free[: len(plan)] - plan).mean(1),
    )
    assert (off[:3] < 0.1 * without[:3]).all()
    assert (off[3:] < without[3:]).all()
    assert off[3] < off[-1]  # it follows closely at first, loosely at the end


@pytest.mark.verifies("batches")
@pytest.mark.parametrize("noise_level", [0.0, 0.5])
def test_no_bit_depends_on_the_batch_where_passes_have_one_size(
    folder: Path, noise_level: float
) -> None:
    with invariant(8) as report:
        policy = made(folder, noise_level=noise_level)
    assert report.variation is None

    def observe(robot: int, tick: int) -> Obs:
        plan = np.ones((6, tiny.ACTION_DIM), np.float32)
        info = [{}, {LEFTOVER: plan, DELAY: 2}, {SAMPLES: 1}][(robot + tick) % 3]
        return seen(100 * tick + robot, (120 + robot, 160), **info)

    compared, differing = differing_acts(
        policy, lambda robot: begun(policy, robot), observe, ticks=2, rounds=2
    )
    assert compared == 2 * 2 * 11
    assert differing == []


@pytest.mark.verifies("isolation")
def test_a_neighbours_plan_changes_nothing(loaded: Pi0) -> None:
    plan = np.ones((6, tiny.ACTION_DIM), np.float32)
    views = [seen(0), seen(1, **{LEFTOVER: plan, DELAY: 2})]
    acts = loaded.act_batch(views, [begun(loaded, 0), begun(loaded, 1)])
    np.testing.assert_allclose(acts[0].action, begun(loaded, 0).act(seen(0)).action, atol=BATCHED)
    alone = begun(loaded, 1).act(views[1]).action
    np.testing.assert_allclose(acts[1].action, alone, atol=BATCHED)


def test_a_long_instruction_is_refused_and_not_cut_off(loaded: Pi0) -> None:
    with pytest.raises(InvalidObservation, match="expected at most 48"):
        copy.copy(loaded).reset(seen(0), "pick up the cube " * 20)


def test_an_instruction_with_the_token_of_an_image_is_refused(loaded: Pi0) -> None:
    with pytest.raises(InvalidObservation, match="it stands for an image"):
        copy.copy(loaded).reset(seen(0), "pick up the <image>")


def test_a_camera_that_is_not_there_is_named(loaded: Pi0) -> None:
    obs = seen(0)
    del obs.cameras["wrist"]
    with pytest.raises(MissingCamera, match="wrist"):
        begun(loaded, 0).act(obs)


@pytest.mark.verifies("loading")
@pytest.mark.parametrize("file", ["config.json", "processor_config.json", "model.safetensors"])
def test_a_missing_file_is_named(whole: Path, file: str) -> None:
    (whole / file).unlink()
    with pytest.raises(ConfigError, match=file.replace("model", "")):
        made(whole)


@pytest.mark.verifies("loading")
def test_missing_statistics_are_an_error(tmp_path: Path) -> None:
    tiny.save(tmp_path, statistics=False)
    with pytest.raises(ConfigError, match=r"expected \['state_mean', .*'actions_std'\], got none"):
        made(tmp_path)


@pytest.mark.verifies("loading")
def test_a_lost_tensor_is_an_error_and_not_random(whole: Path) -> None:
    tensors = load_file(whole / "model.safetensors")
    del tensors["action_out_proj.bias"]
    save_file(tensors, whole / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ConfigError, match=r"action_out_proj\.bias"):
        made(whole)


@pytest.mark.verifies("loading")
def test_a_tensor_of_another_shape_is_an_error(whole: Path) -> None:
    tensors = load_file(whole / "model.safetensors")
    tensors["action_out_proj.bias"] = tensors["action_out_proj.bias"][:-1].clone()
    save_file(tensors, whole / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ConfigError, match=r"action_out_proj\.bias|does not load"):
        made(whole)


@pytest.mark.parametrize("cameras", [{}, {"agentview": "front"}])
def test_cameras_that_the_model_does_not_have_are_an_error(cameras: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match=r"expected .*base_0_rgb"):
        Pi0.from_config({"checkpoint": "any", "cameras": cameras})


def test_in_bfloat16_it_stays_near_float32(folder: Path, loaded: Pi0) -> None:
    half = made(folder, dtype="bfloat16")
    np.testing.assert_allclose(
        begun(half, 0).act(seen(0)).action, begun(loaded, 0).act(seen(0)).action, atol=0.1
    )


def test_statistics_are_those_that_were_saved(whole: Path) -> None:
    saved = json.loads((whole / "processor_config.json").read_text())
    saved["actions_mean"] = [100.0] * tiny.ACTION_DIM
    (whole / "processor_config.json").write_text(json.dumps(saved))
    policy = made(whole)
    assert (begun(policy, 0).act(seen(0)).action > 50).all()


@pytest.mark.library("torchao")
@pytest.mark.parametrize(("kind", "error"), [("int8", 0.02), ("float8", 0.1)])
def test_quantized_it_acts_nearly_alike_from_less_memory(
    loaded: Pi0, folder: Path, kind: str, error: float
) -> None:
    quantized = made(folder, quantization=kind)
    whole = begun(loaded, 0).act(seen(0)).action
    off = np.abs(begun(quantized, 0).act(seen(0)).action - whole).max() / np.abs(whole).max()
    assert 0 < off < error
    layers = [
        layer for layer in quantized.model.network.modules() if isinstance(layer, torch.nn.Linear)
    ]
    assert layers
    assert all(type(layer.weight).__name__.lower().startswith(kind) for layer in layers)
    with pytest.raises(NotTrainable, match="quantization"):
        quantized.parameters()


@pytest.mark.library("torchao")
def test_products_of_8_bits_are_refused_on_a_cpu(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"quantization 'float8_dynamic': torchao cannot use it on this machine"
    ):
        made(folder, quantization="float8_dynamic", compile=True)
