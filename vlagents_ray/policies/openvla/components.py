"""What OFT's fine-tuning adds to OpenVLA, each part in a file of its own: heads, projectors, FiLM.

They are small, so that their tensors are applied as they are, by the formulas of upstream's prismatic/models; all
sizes are the tensors' own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

Weights = Mapping[str, Any]  # tensors by name

_MLP = ("layer_norm1", "fc1", *(f"mlp_resnet_blocks.{i}.ffn.{j}" for i in (0, 1) for j in (0, 1)), "layer_norm2", "fc2")
_WRAPPED = "module."  # before all names where training was distributed
_LORA_ALPHA = 16  # upstream's scale is min(rank, 16) / rank


def read_component(folder: Path, name: str) -> dict[str, Any]:
    """The tensors in the only file `name--*_checkpoint.pt`; one that is missing or not alone is a `ConfigError`."""
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
    """Raise `ConfigError` for a component that is there and that the settings leave out."""
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
    """A head: MLP with residual blocks over the hidden states of one row's action tokens."""

    def __init__(self, saved: Weights, prefix: str) -> None:
        own = _exactly(saved, [f"{prefix}.{layer}" for layer in _MLP], "action_head")
        self._weights = {key.removeprefix(f"{prefix}."): tensor for key, tensor in own.items()}

    @property
    def dim(self) -> int:
        """Numbers of one row of actions."""
        return len(self._weights["fc2.bias"])

    def to(self, **place: Any) -> Mlp:
        """Moved to a device and dtype."""
        self._weights = {key: tensor.to(**place) for key, tensor in self._weights.items()}
        return self

    def __call__(self, x: Any) -> Any:
        """(…, in) to (…, dim)."""
        relu = require("torch").relu
        x = relu(_linear(self._weights, "fc1", _norm(self._weights, "layer_norm1", x)))
        for i in (0, 1):
            block = f"mlp_resnet_blocks.{i}.ffn"
            x = x + relu(_linear(self._weights, f"{block}.1", _norm(self._weights, f"{block}.0", x)))
        return _linear(self._weights, "fc2", _norm(self._weights, "layer_norm2", x))


class Projector:
    """Numbers as embeddings of the language model: two layers with GELU between."""

    def __init__(self, saved: Weights, what: str) -> None:
        self._weights = _exactly(saved, ("fc1", "fc2"), what)

    @property
    def dim(self) -> int:
        """Numbers that go in."""
        return int(self._weights["fc1.weight"].shape[1])

    def to(self, **place: Any) -> Projector:
        """Moved to a device and dtype."""
        self._weights = {key: tensor.to(**place) for key, tensor in self._weights.items()}
        return self

    def __call__(self, x: Any) -> Any:
        """(…, dim) to (…, D)."""
        gelu = require("torch").nn.functional.gelu
        return _linear(self._weights, "fc2", gelu(_linear(self._weights, "fc1", x)))


class Film:
    """Vision backbones whose blocks are scaled and shifted by the instruction (arXiv 1709.07871)."""

    def __init__(self, saved: Weights, backbone: Any) -> None:
        """Takes its own tensors out of `saved`, and loads the others into the backbone that it goes with."""
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
        """Moved to a device and dtype; the backbone goes with the model that it is part of."""
        self._film = {key: tensor.to(**place) for key, tensor in self._film.items()}
        return self

    def __call__(self, pixels: Any, language: Any) -> Any:
        """Patches (B, P, V) of pixels (B, C, S, S) for instructions (B, D), each the mean of its embeddings."""
        torch = require("torch")
        parts = pixels.split(3, dim=1)
        return torch.cat([self._see(name, part, language) for name, part in zip(self._vits, parts, strict=True)], dim=2)

    def _see(self, name: str, pixels: Any, language: Any) -> Any:
        """What the last block but one gives, as OpenVLA takes it."""
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
    """With the low-rank adapters added to the layers that they adapt, convolutions too: OFT+ saves them apart."""
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
    return require("torch").nn.functional.linear(x, weights[f"{layer}.weight"], weights[f"{layer}.bias"])


def _norm(weights: Weights, layer: str, x: Any) -> Any:
    bias = weights[f"{layer}.bias"]
    return require("torch").nn.functional.layer_norm(x, bias.shape, weights[f"{layer}.weight"], bias)
