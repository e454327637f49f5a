"""V-JEPA 2's image encoder in transformers, loaded from its own format or from upstream's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained, require_loaded
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.vjepa2_ac.config import VJepa2AcConfig
from vlagents_ray.registry import require

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, for colours in [0, 1]
_HEADS = {1024: 16, 1280: 16, 1408: 22}  # of ViT-L, ViT-H and ViT-g, by their width

_PATCHES = "encoder.embeddings.patch_embeddings.proj.weight"


def to_pixels(image: np.ndarray, side: int) -> np.ndarray:
    """Crop, resize and normalise an (H, W, 3) uint8 image as upstream, to (3, side, side) float32."""
    torch = require("torch")
    height, width = image.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    square = torch.tensor(image[top : top + edge, left : left + edge], dtype=torch.float32).permute(2, 0, 1)[None]
    resized = torch.nn.functional.interpolate(square, size=(side, side), mode="bilinear", align_corners=False)[0]
    mean, std = (torch.tensor(values)[:, None, None] * 255 for values in (_MEAN, _STD))
    return np.asarray(((resized - mean) / std).numpy())


class Encoder:
    """Computes features of still images, which are repeated for the two frames of one step of the encoder."""

    def __init__(self, model: Any, normalize: bool, compilation: Compilation) -> None:
        self._model = model
        self._normalized = normalizer(normalize)
        self._encode = compilation.core("encode", self._features)

    def __call__(self, pixels: Sequence[np.ndarray]) -> Any:
        """Compute features (B, N, F) of images, each (3, side, side) float32."""
        images = require("torch").as_tensor(np.stack(pixels))
        return self._encode(images.to(self._model.device, self._model.dtype, non_blocking=True))

    def _features(self, images: Any) -> Any:
        clip = images[:, None].repeat(1, 2, 1, 1, 1)
        return self._normalized(self._model(pixel_values_videos=clip, skip_predictor=True).last_hidden_state.float())


def normalizer(normalize: bool) -> Callable[[Any], Any]:
    """Return a function that normalises features (..., F), or else returns them as they are."""
    layer_norm = require("torch").nn.functional.layer_norm
    return lambda features: layer_norm(features, features.shape[-1:]) if normalize else features


def load_encoder(config: VJepa2AcConfig, saved: Mapping[str, Any] | None) -> Any:
    """Load the `VJEPA2Model` of `config.encoder`, or make one with upstream's weights `saved`."""
    ensure_torchvision()
    transformers = require("transformers")
    if config.encoder is not None:
        path = find_checkpoint(config.encoder, needs=("config.json", "*.safetensors"))
        model = from_pretrained(transformers.VJEPA2Model, path)
        if model.config.crop_size != config.image_size:
            raise ConfigError(
                f"encoder {path}: made for images of {model.config.crop_size} px, want {config.image_size} as in "
                f"image_size; give that of the checkpoint's predictor"
            )
        return model
    if saved is None:
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: it has no 'encoder'; name a folder with a VJEPA2Model as the policy's "
            f"`encoder`, or a checkpoint with both, such as vjepa2-ac-vitg.pt"
        )
    return from_upstream(saved, config)


def from_upstream(saved: Mapping[str, Any], config: VJepa2AcConfig) -> Any:
    """Make a `VJEPA2Model` with upstream's weights; raises `ConfigError` if some are missing."""
    transformers = require("transformers")
    tensors = _renamed(saved)
    width, _, tubelet, patch, _ = tensors[_PATCHES].shape
    heads = config.encoder_heads or _HEADS.get(width)
    if heads is None:
        raise ConfigError(f"encoder_heads: unset, and {width} is the width of none of {sorted(_HEADS)}; set it")
    settings = transformers.VJEPA2Config(
        patch_size=patch,
        crop_size=config.image_size,
        tubelet_size=tubelet,
        hidden_size=width,
        num_attention_heads=heads,
        num_hidden_layers=len({name.split(".")[2] for name in tensors if name.startswith("encoder.layer.")}),
        mlp_ratio=tensors["encoder.layer.0.mlp.fc1.weight"].shape[0] / width,
        pred_num_hidden_layers=1,  # V-JEPA 2's own predictor of masked patches is not used
    )
    model = transformers.VJEPA2Model(settings)
    model.predictor = require("torch").nn.Identity()
    missing, _ = model.load_state_dict(tensors, strict=False)
    if missing:
        raise ConfigError(f"the checkpoint's encoder lacks {missing[:8]}; is it upstream's, and whole?")
    require_loaded(model, tensors)
    return model


def _renamed(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Rename upstream's tensors to transformers' names; query, key and value are one matrix upstream."""
    tensors: dict[str, Any] = {}
    for name, tensor in saved.items():
        new = (
            f"encoder.{name}".replace("encoder.patch_embed.", "encoder.embeddings.patch_embeddings.")
            .replace("encoder.norm.", "encoder.layernorm.")
            .replace("encoder.blocks.", "encoder.layer.")
            .replace(".attn.", ".attention.")
        )
        kinds = ("query", "key", "value") if ".qkv." in new else ("qkv",)
        for kind, share in zip(kinds, tensor.chunk(len(kinds)), strict=True):
            tensors[new.replace("qkv", kind)] = share
    if _PATCHES not in tensors or "encoder.layer.0.mlp.fc1.weight" not in tensors:
        raise ConfigError(
            f"the checkpoint's encoder: got {sorted(saved)[:4]}, want names as 'patch_embed.proj.weight', upstream's"
        )
    return tensors
