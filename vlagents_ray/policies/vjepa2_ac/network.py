"""V-JEPA 2's vision encoder and the predictor of the next frames, as their authors' code has them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.policies.base.accelerator import ensure_torchvision
from vlagents_ray.policies.base.checkpoint import find_checkpoint, from_pretrained, require_loaded
from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.policies.base.model_code import use_source
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.registry import require


class VJepa2AcConfig(ModelConfig):
    """Settings of V-JEPA 2-AC, beside those of all models: its checkpoint, and the search for plans."""

    deterministic: Literal[False] = Field(default=False, description="not for this family")
    encoder: str | None = Field(
        default=None,
        description="folder or hub id (org/name@COMMIT) of a `VJEPA2Model` instead of the encoder in the checkpoint",
    )
    source_dir: str | None = Field(
        default=None,
        description="checkout of vjepa2, for the predictor's code; unset: that of VJEPA2_SRC, or installed",
    )
    encoder_heads: int | None = Field(
        default=None, ge=1, description="attention heads of the checkpoint's encoder; unset: those of ViT-L, -H or -g"
    )
    predictor_heads: int = Field(default=16, ge=1, description="attention heads of the predictor")
    image_size: int = Field(default=256, ge=16, description="pixels of a side, as the model was trained")
    normalize: bool = Field(default=True, description="normalise features, as the model was trained")

    execute: int | None = Field(default=1, ge=1, description="steps of a plan that are executed; in the paper one")
    rollout: int = Field(default=2, ge=1, description="steps of a plan")
    samples: int = Field(default=400, ge=2, description="plans sampled in an iteration")
    topk: int = Field(default=10, ge=2, description="number of best plans that determine the next distribution")
    iterations: int = Field(default=10, ge=1)
    momentum_mean: float = Field(default=0.15, ge=0, lt=1, description="share of the last iteration's mean position")
    momentum_std: float = Field(default=0.15, ge=0, lt=1)
    momentum_mean_gripper: float = Field(default=0.15, ge=0, lt=1)
    momentum_std_gripper: float = Field(default=0.15, ge=0, lt=1)
    maxnorm: float = Field(default=0.05, gt=0, description="largest step along each axis, m")
    close_gripper: int | None = Field(default=None, ge=0, description="step of a plan from which on the gripper closes")
    pass_size: int = Field(default=400, ge=1, description="largest number of plans in a forward pass of the predictor")

    @property
    def plans_a_pass(self) -> int:
        """The largest number of plans in a forward pass of the predictor; compiled, every full pass has as many."""
        return min(self.samples, self.pass_size) if self.compile else self.pass_size

    @model_validator(mode="after")
    def _chosen_from_more(self) -> Self:
        if self.topk > self.samples:
            raise ValueError(f"topk {self.topk} is over samples {self.samples}; want it to be a small part of them")
        return self


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


_PREFIXES = ("module.", "backbone.")  # added by distributed training and upstream's wrapper


def read_checkpoint(config: VJepa2AcConfig) -> dict[str, dict[str, Any]]:
    """Read the tensors of the parts of upstream's file, "encoder" and "predictor"; nothing is unpickled."""
    torch = require("torch")
    path = find_checkpoint(config.checkpoint, config.checkpoint_step, needs=("*.pt",))
    file = path if path.is_file() else _only(path)
    try:
        parts = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # it may not be a zip file, or a pickle of other types
        raise ConfigError(
            f"checkpoint {file}: not a file of tensors ({type(error).__name__}); want upstream's .pt"
        ) from error
    if not isinstance(parts, Mapping) or not isinstance(parts.get("predictor"), Mapping):
        got = sorted(map(str, parts))[:8] if isinstance(parts, Mapping) else type(parts).__name__
        raise ConfigError(
            f"checkpoint {file}: got {got}, want 'predictor' among them; is it V-JEPA 2-AC's, and not V-JEPA 2's?"
        )
    return {name: _clean(part) for name, part in parts.items() if isinstance(part, Mapping)}


def load_predictor(config: VJepa2AcConfig, saved: Mapping[str, Any], width: int) -> Any:
    """Load the predictor; raises `ConfigError` if its code or a weight is missing, or the encoder does not fit."""
    use_source("src", "VJEPA2_SRC", config.source_dir)
    try:
        module = importlib.import_module("src.models.ac_predictor")
    except ModuleNotFoundError as error:
        raise MissingDependency(
            f"the predictor's code cannot be imported: no module {error.name!r}; is `src` vjepa2's, and timm installed?"
        ) from error
    embedding = saved.get("predictor_embed.weight")
    if embedding is None or embedding.shape[1] != width:
        got = (
            "no 'predictor_embed.weight'" if embedding is None else f"a predictor of features {embedding.shape[1]} wide"
        )
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: got {got}, want {width}, the encoder's; they belong together"
        )
    model = module.vit_ac_predictor(
        img_size=(config.image_size, config.image_size),
        num_frames=2 * config.rollout,  # tubelets have two frames; this sets the mask's size only
        tubelet_size=2,
        embed_dim=width,
        predictor_embed_dim=embedding.shape[0],
        depth=len({name.split(".")[1] for name in saved if name.startswith("predictor_blocks.")}),
        num_heads=config.predictor_heads,
    )
    try:
        model.load_state_dict(saved)
    except RuntimeError as error:
        raise ConfigError(
            f"checkpoint {config.checkpoint!r}: its predictor does not fit: {str(error)[:500]}"
        ) from error
    require_loaded(model, saved)
    return model


@contextmanager
def usual_attention() -> Iterator[None]:
    """Have upstream's attention use torch's choice of a kernel as it is.

    Upstream sets that choice to torch's default for each layer, by a deprecated function that cannot be compiled.
    """
    backend = require("torch").backends.cuda
    setter, backend.sdp_kernel = backend.sdp_kernel, nullcontext
    try:
        yield
    finally:
        backend.sdp_kernel = setter


def _only(folder: Path) -> Path:
    files = sorted(folder.glob("*.pt"))
    if len(files) != 1:
        raise ConfigError(f"checkpoint {folder}: got {[file.name for file in files]}, want one .pt file; name it")
    return files[0]


def _clean(part: Mapping[str, Any]) -> dict[str, Any]:
    """Rename tensors to the names of the model itself."""
    cleaned = {}
    for name, tensor in part.items():
        for prefix in _PREFIXES:
            name = str(name).replace(prefix, "")  # noqa: PLW2901 - step by step
        cleaned[str(name)] = tensor
    return cleaned
