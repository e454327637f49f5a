"""The components that OFT's fine-tuning adds to OpenVLA, each in its own file: heads, projectors, FiLM.

They are small, so their tensors are used directly, by the formulas of upstream's prismatic/models; all sizes are the
tensors' own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

Weights = Mapping[str, Any]  # tensors by name

_MLP = ("layer_norm1", "fc1", *(f"mlp_resnet_blocks.{i}.ffn.{j}" for i in (0, 1) for j in (0, 1)), "layer_norm2", "fc2")
_WRAPPED = "module."  # prefix of all names after distributed training
_LORA_ALPHA = 16  # upstream's scale is min(rank, 16) / rank


def read_component(folder: Path, name: str) -> dict[str, Any]:
    """Return the tensors of the only file `name--*_checkpoint.pt`; raises `ConfigError` if there is none or several."""
    files = sorted(path.name for path in folder.glob(f"{name}--*checkpoint.pt"))
    if len(files) != 1:
        have = sorted(path.name for path in folder.glob("*.pt"))
        raise ConfigError(
            f"checkpoint {folder}: got {files or have} for {name!r}, want one file {name}--STEP_checkpoint.pt; copy it "
            f"there, or check `head`, `film` and `state` against how the checkpoint was trained"
        )
    saved = require("torch").load(folder / files[0], map_location="cpu", weights_only=True)
    return {key.removeprefix(_WRAPPED): tensor for key, tensor in saved.items()}


def require_unused(folder: Path, names: Iterable[str]) -> None:
    """Raise `ConfigError` if a component exists that the settings leave out."""
    for name in names:
        if any(folder.glob(f"{name}--*")):
            raise ConfigError(
                f"checkpoint {folder}: has {name}--…, which these settings do not use; set `head`, `film` and `state` "
                f"to how the checkpoint was trained, or move the file away"
            )


def _exactly(found: Weights, layers: Iterable[str], what: str) -> Weights:
    want = {f"{layer}.{part}" for layer in layers for part in ("weight", "bias")}
    if set(found) != want:
        raise ConfigError(
            f"{what}: misses {sorted(want - set(found))}, has {sorted(set(found) - want)} too; is it of another kind?"
        )
    return found


class Mlp:
    """A head: an MLP with residual blocks over the hidden states of one row's action tokens."""

    def __init__(self, saved: Weights, prefix: str) -> None:
        own = _exactly(saved, [f"{prefix}.{layer}" for layer in _MLP], "action_head")
        self._weights = {key.removeprefix(f"{prefix}."): tensor for key, tensor in own.items()}

    @property
    def dim(self) -> int:
        """The length of an action."""
        return len(self._weights["fc2.bias"])

    def to(self, **place: Any) -> Mlp:
        """Move the tensors to a device and dtype."""
        self._weights = {key: tensor.to(**place) for key, tensor in self._weights.items()}
        return self

    def __call__(self, x: Any) -> Any:
        """Map (…, in) to (…, dim)."""
        relu = require("torch").relu
        x = relu(_linear(self._weights, "fc1", _norm(self._weights, "layer_norm1", x)))
        for i in (0, 1):
            block = f"mlp_resnet_blocks.{i}.ffn"
            x = x + relu(_linear(self._weights, f"{block}.1", _norm(self._weights, f"{block}.0", x)))
        return _linear(self._weights, "fc2", _norm(self._weights, "layer_norm2", x))


class Projector:
    """Maps numbers to embeddings of the language model: two layers with GELU between them."""

    def __init__(self, saved: Weights, what: str) -> None:
        self._weights = _exactly(saved, ("fc1", "fc2"), what)

    @property
    def dim(self) -> int:
        """The length of the input."""
        return int(self._weights["fc1.weight"].shape[1])

    def to(self, **place: Any) -> Projector:
        """Move the tensors to a device and dtype."""
        self._weights = {key: tensor.to(**place) for key, tensor in self._weights.items()}
        return self

    def __call__(self, x: Any) -> Any:
        """Map (…, dim) to (…, D)."""
        gelu = require("torch").nn.functional.gelu
        return _linear(self._weights, "fc2", gelu(_linear(self._weights, "fc1", x)))


class Film:
    """Vision backbones whose blocks are scaled and shifted by the instruction (arXiv 1709.07871)."""

    def __init__(self, saved: Weights, backbone: Any) -> None:
        """Take FiLM's tensors from `saved`, and load the others into the backbone."""
        plain, self._film = {}, {}
        for key, tensor in _merged(saved).items():
            name = key.removeprefix("vision_backbone.")
            if ".scale." in name or ".shift." in name:
                self._film[name] = tensor
            else:
                plain[name.replace(".block.", ".")] = tensor
        try:
            backbone.load_state_dict(plain)
        except RuntimeError as error:
            raise ConfigError(f"vision_backbone: not the checkpoint's ({error})") from error
        vits = {n: getattr(backbone, n) for n in ("featurizer", "fused_featurizer") if hasattr(backbone, n)}
        layers = [
            f"{n}.blocks.{i}.{way}" for n, v in vits.items() for i in range(len(v.blocks)) for way in ("scale", "shift")
        ]
        _exactly(self._film, layers, "vision_backbone")
        self._vits = vits

    def to(self, **place: Any) -> Film:
        """Move the tensors to a device and dtype; the backbone moves with its model."""
        self._film = {key: tensor.to(**place) for key, tensor in self._film.items()}
        return self

    def __call__(self, pixels: Any, language: Any) -> Any:
        """Return patches (B, P, V) of pixels (B, C, S, S) for instructions (B, D), each the mean of its embeddings."""
        import torch  # the compiler follows a statement, and not `require`

        parts = pixels.split(3, dim=1)
        return torch.cat([self._see(name, part, language) for name, part in zip(self._vits, parts, strict=True)], dim=2)

    def _see(self, name: str, pixels: Any, language: Any) -> Any:
        """Return the output of the second to last block, which OpenVLA uses."""
        vit = self._vits[name]
        x = vit.norm_pre(vit.patch_drop(vit._pos_embed(vit.patch_embed(pixels))))
        for i, block in enumerate(vit.blocks[:-1]):
            layer = f"{name}.blocks.{i}"
            scale, shift = (_linear(self._film, f"{layer}.{way}", language)[:, None] for way in ("scale", "shift"))
            x = x + block.ls1(block.attn(block.norm1(x)))
            x = x * (1 + scale) + shift
            x = x + block.ls2(block.mlp(block.norm2(x)))
        return x[:, vit.num_prefix_tokens :]


def _merged(saved: Weights) -> dict[str, Any]:
    """Add the low-rank adapters to their layers, also to convolutions: OFT+ saves them separately."""
    merged = {key.replace(".base_layer.", "."): tensor for key, tensor in saved.items() if ".lora_" not in key}
    for key, down in saved.items():
        if ".lora_A." in key:
            up = saved[key.replace(".lora_A.", ".lora_B.")]
            rank = len(down)
            name = key.partition(".lora_A.")[0] + ".weight"
            added = up.flatten(1).float() @ down.flatten(1).float() * (min(rank, _LORA_ALPHA) / rank)
            merged[name] = (merged[name].float() + added.view_as(merged[name])).to(merged[name].dtype)
    return merged


def _linear(weights: Weights, layer: str, x: Any) -> Any:
    import torch

    return torch.nn.functional.linear(x, weights[f"{layer}.weight"], weights[f"{layer}.bias"])


def _norm(weights: Weights, layer: str, x: Any) -> Any:
    import torch

    bias = weights[f"{layer}.bias"]
    return torch.nn.functional.layer_norm(x, bias.shape, weights[f"{layer}.weight"], bias)
