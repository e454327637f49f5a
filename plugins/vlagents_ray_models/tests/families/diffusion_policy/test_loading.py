"""What of a checkpoint or its settings does not fit is said before anything is served."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plugins.vlagents_ray_models.tests.families.diffusion_policy import tiny
from plugins.vlagents_ray_models.tests.families.diffusion_policy.conftest import (
    LIBRARIES,
    Checkpoint,
    loaded,
)
from vlagents_ray.errors import ConfigError

pytestmark = [pytest.mark.source("DIFFUSION_POLICY_SRC"), *LIBRARIES]


def test_a_file_of_something_else_is_named(tmp_path: Path) -> None:
    path = tmp_path / "latest.ckpt"
    path.write_bytes(b"not even a pickle")
    with pytest.raises(
        ConfigError, match="of a Diffusion Policy workspace wrote, got no such payload"
    ):
        loaded(path)


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"cameras": {"image": "front", "top": "front"}},
            r"expected .* \['image'\], got \['image', 'top'\]",
        ),
        ({"cameras": {}}, r"expected .* \['image'\], got \[\]"),
        ({"device": "nowhere"}, "device 'nowhere': not available"),
        ({"dtype": "bfloat16"}, "dtype"),
        ({"checkpoint_step": 3}, "checkpoint_step"),
    ],
)
def test_settings_that_do_not_fit_the_checkpoint(
    checkpoint: Checkpoint, config: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(checkpoint("image"), **config)


@pytest.mark.verifies("loading")
def test_a_checkpoint_without_its_normalizer_is_refused(tmp_path: Path) -> None:
    path = tiny.save(tmp_path / "unnormalized", "unet", normalizer=False)
    with pytest.raises(ConfigError, match=r"normalizer has nothing for \['action', 'obs'\]"):
        loaded(path)


def test_a_checkpoint_without_the_weights_that_its_settings_want_is_refused(tmp_path: Path) -> None:
    path = tiny.save(tmp_path / "raw", "unet", use_ema=False)
    with pytest.raises(ConfigError, match=r"expected 'model'.*got \['ema_model'\]"):
        loaded(path)


def _spoilt(path: Path, to: Path, change: Callable[[Any], None]) -> Path:
    import dill
    import torch

    payload = torch.load(path, map_location="cpu", pickle_module=dill, weights_only=False)
    change(payload)
    torch.save(payload, to, pickle_module=dill)
    return to


@pytest.mark.verifies("loading")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda payload: payload["state_dicts"]["ema_model"].popitem(last=False),
            "does not fill its own policy",
        ),
        (
            lambda payload: payload["cfg"].policy.model.update(down_dims=[16, 16]),
            "does not fill its own policy",
        ),
        (lambda payload: payload.pop("cfg"), "got no such payload"),
    ],
)
def test_a_checkpoint_that_is_not_whole(
    checkpoint: Checkpoint, tmp_path: Path, change: Callable[[Any], None], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(_spoilt(checkpoint("unet"), tmp_path / "spoilt.ckpt", change))


def test_weights_that_training_began_with_are_not_downloaded(
    checkpoint: Checkpoint, tmp_path: Path
) -> None:
    def began(payload: Any) -> None:
        payload["cfg"].policy.obs_encoder.rgb_model.weights = "IMAGENET1K_V1"

    policy = loaded(_spoilt(checkpoint("image"), tmp_path / "pretrained.ckpt", began), steps=2)
    assert policy.model.module.num_inference_steps == 2


def test_crops_at_random_are_refused(checkpoint: Checkpoint) -> None:
    with pytest.raises(ConfigError, match="eval_fixed_crop"):
        loaded(checkpoint("random_crops"))
