"""Checkpoints and settings that do not fit are errors before anything is served."""

from __future__ import annotations

import json
import shutil
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plugins.vlagents_ray_models.tests.families.octo.conftest import MARKS
from vlagents_ray.errors import ConfigError
from vlagents_ray_models.octo import Octo, real_actions, resized

pytestmark = MARKS


def load(checkpoint: Path | str, **config: Any) -> Octo:
    policy = Octo.from_config(
        {"checkpoint": str(checkpoint), "dataset": "bridge_dataset", **config}
    )
    policy.model = policy.load()
    return policy


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"dataset": "bridge"}, r"bridge_dataset.*fractal20220817_data.*no statistics of 'action'"),
        ({"dataset": None}, "bridge_dataset.*no statistics of 'action'"),
        (
            {"cameras": {"image_top": "front"}},
            r"expected .* \['image_primary', 'image_wrist'\], got \['image_top'\]",
        ),
        (
            {"normalization": "bounds"},
            r"have \['mask', 'mean', 'std'\].*p01.*set it as in training",
        ),
        ({"window": 5}, "expected at most 4, got 5; set 2, as in training"),
        ({"state": ["joints"]}, "expected no state"),
        ({"device": "tpu:1"}, "'tpu:1': not available, JAX finds"),
    ],
)
def test_settings_that_do_not_fit_the_checkpoint(
    pretrained: Path, config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        load(pretrained, **config)


def test_a_checkpoint_that_reads_a_state_needs_its_parts(finetuned: Path) -> None:
    with pytest.raises(ConfigError, match="expected a state of 3 numbers"):
        load(finetuned, dataset=None)


def _without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def _deeper(folder: Path) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    config["model"]["transformer_kwargs"]["num_layers"] = 2
    path.write_text(json.dumps(config))


def _wider(folder: Path) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    config["model"]["transformer_kwargs"]["mlp_dim"] = 32
    path.write_text(json.dumps(config))


def _elsewhere(folder: Path) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    config["text_processor"]["kwargs"]["tokenizer_name"] = str(folder / "no-t5")
    path.write_text(json.dumps(config))


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_without("config.json"), r"expected \['config.json'\]"),
        (_without("dataset_statistics.json"), r"expected \['dataset_statistics.json'\]"),
        (lambda folder: shutil.rmtree(folder / "7"), "expected a step"),
        (lambda folder: shutil.rmtree(folder / "7" / "default"), "could not load"),
        (_elsewhere, "could not load.*no-t5"),
        (_deeper, "could not load|does not fill"),
        (_wider, "does not fill the model.*another shape"),
    ],
)
def test_a_checkpoint_that_is_not_whole(
    pretrained: Path, tmp_path: Path, spoil: Callable[[Path], None], message: str
) -> None:
    folder = tmp_path / "spoilt"
    shutil.copytree(pretrained, folder)
    spoil(folder)
    with pytest.raises(ConfigError, match=message):
        load(folder)


def test_a_step_is_taken_by_its_number(pretrained: Path) -> None:
    policy = load(f"{pretrained}/{{step}}", checkpoint_step=7, window=3, actions="queue")
    assert (policy.history, policy.contract.chunk) == (3, 1)
    with pytest.raises(ConfigError, match="no such file or folder"):
        load(f"{pretrained}/{{step}}", checkpoint_step=8)


def test_images_are_as_octos_own_wrapper_makes_them(
    monkeypatch: pytest.MonkeyPatch, pretrained: Path
) -> None:
    class Wrapper:
        def __init__(self, env: Any) -> None:
            self.observation_space = env.observation_space

    class Dict:
        def __init__(self, spaces: dict[str, Any]) -> None:
            self.spaces = spaces

    spaces = types.SimpleNamespace(Dict=Dict, Box=lambda **_: None)
    gym: Any = types.ModuleType("gym")  # with the names that Octo's wrapper uses
    gym.Wrapper = gym.ObservationWrapper = Wrapper
    gym.spaces, gym.Env, gym.Space = spaces, object, object
    monkeypatch.setitem(sys.modules, "gym", gym)
    monkeypatch.setitem(sys.modules, "gym.spaces", spaces)
    from octo.utils.gym_wrappers import ResizeImageWrapper

    env = types.SimpleNamespace(observation_space=Dict({}))
    wrapper = ResizeImageWrapper(env, {"primary": (256, 256), "wrist": (128, 128)})
    rng = np.random.default_rng(0)
    front = rng.integers(0, 256, (90, 160, 3), np.uint8)
    wrist = rng.integers(0, 256, (90, 160, 3), np.uint8)
    expected = wrapper.observation({"image_primary": front, "image_wrist": wrist})
    assert np.array_equal(resized(front, 256, 256, crop=True), expected["image_primary"])
    assert np.array_equal(resized(wrist, 128, 128, crop=False), expected["image_wrist"])


def test_an_image_of_the_right_size_is_copied() -> None:
    image = np.random.default_rng(0).integers(0, 256, (128, 128, 3), np.uint8)
    copied = resized(image, 128, 128, crop=False)
    assert np.array_equal(copied, image)
    assert not np.shares_memory(copied, image)


def test_normalised_bounds_are_converted_to_units() -> None:
    statistics = {
        "p01": np.array([-2.0, 0.0]),
        "p99": np.array([4.0, 1.0]),
        "mask": np.array([True, False]),
    }
    actions = real_actions(np.array([[-1.0, 0.7], [1.0, 0.2]]), statistics, "bounds")
    np.testing.assert_allclose(actions, [[-2.0, 0.7], [4.0, 0.2]])
