"""V-JEPA 2's encoder in transformers' format: images to features, without upstream's source."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from plugins.vlagents_ray_models.tests.families.vjepa2_ac.tiny import (
    PATCH,
    SIDE,
    WIDTH,
    make_hf_encoder,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray_models.vjepa2_ac import VJepa2AcConfig, WorldModel, load_encoder, to_pixels


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_hf_encoder(tmp_path_factory.mktemp("encoder"))


def config(**settings: Any) -> VJepa2AcConfig:
    return VJepa2AcConfig(**{"checkpoint": "none", "image_size": SIDE, **settings})


def pixels(count: int) -> torch.Tensor:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (40, 60, 3), dtype=np.uint8) for _ in range(count)]
    return torch.as_tensor(np.stack([to_pixels(image, SIDE) for image in images]))


def encoding(model: Any) -> Any:
    return WorldModel(model, None, config(), torch.float32, Compilation(mode=False)).encode


@torch.inference_mode()
@pytest.mark.verifies("batches")
def test_an_image_gives_the_same_features_in_a_batch_of_any_size(folder: Path) -> None:
    encode = encoding(load_encoder(config(encoder=str(folder)), None).eval())
    together = encode(pixels(8))
    assert together.shape == (8, (SIDE // PATCH) ** 2, WIDTH)
    for size in (1, 2, 3):
        assert torch.allclose(encode(pixels(8)[:size]), together[:size], atol=1e-5)
    assert torch.allclose(together.mean(-1), torch.zeros(1), atol=1e-5)


@torch.inference_mode()
@pytest.mark.verifies("parity")
def test_features_are_those_of_transformers_for_an_image_shown_twice(folder: Path) -> None:
    model = load_encoder(config(encoder=str(folder)), None).eval()
    clip = pixels(1)[:, None].expand(-1, 2, -1, -1, -1)
    theirs = model.get_vision_features(clip)
    normalized = torch.nn.functional.layer_norm(theirs, theirs.shape[-1:])
    assert torch.equal(encoding(model)(pixels(1)), normalized)


def test_an_image_is_cut_to_the_square_in_its_middle() -> None:
    image = np.zeros((40, 60, 3), np.uint8)
    image[:, 10:50] = 255
    assert np.allclose(to_pixels(image, 20), to_pixels(np.full((7, 7, 3), 255, np.uint8), 20))
    assert to_pixels(image, 20).shape == (3, 20, 20)


def test_an_encoder_for_images_of_another_size_is_refused(folder: Path) -> None:
    with pytest.raises(ConfigError, match=f"expected images of 256 px.*got {SIDE}"):
        load_encoder(config(encoder=str(folder), image_size=256), None)


@pytest.mark.verifies("loading")
def test_weights_that_are_missing_are_never_random(folder: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    tensors = load_file(folder / "model.safetensors")
    del tensors["encoder.layer.1.attention.key.weight"]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(
        ConfigError, match=r"does not fill VJEPA2Model.*layer\.1\.attention\.key\.weight"
    ):
        load_encoder(config(encoder=str(tmp_path)), None)


@pytest.mark.parametrize("encoder", ["./nowhere", "{folder}/.."])
def test_no_such_encoder(encoder: str, folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"no such file|expected"):
        load_encoder(config(encoder=encoder.format(folder=folder)), None)


def test_without_an_encoder_anywhere_the_cure_is_named() -> None:
    with pytest.raises(ConfigError, match="it has no 'encoder'; name a folder"):
        load_encoder(config(), None)
