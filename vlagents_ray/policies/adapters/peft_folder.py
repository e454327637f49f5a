"""Reads a LoRA adapter as PEFT saves it: `adapter_config.json`, and numbers alone in `adapter_model.safetensors`.

For a linear layer with the weights W (out, in), the file has A (r, in) and B (out, r); the fine-tuned layer computes
with W + scale * B A, where scale is lora_alpha / r (arXiv 2106.09685), or with `use_rslora` lora_alpha / sqrt(r) (arXiv
2312.03732). For a convolution A is one with r channels, of the same kernel, and B maps these at each place.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, MalformedMessage
from vlagents_ray.weights.safetensors import PART_BYTES, ValuesReader, read_header
from vlagents_ray.weights.trainable import converted

CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
FILES = (CONFIG, WEIGHTS)
_PREFIX = "base_model.model."  # of all names in the file
_DOWN, _UP = ".lora_A.weight", ".lora_B.weight"
_BASE = ".base_layer."  # in names of the values of a layer that has an adapter
_LISTED = 5
# Settings that change nothing about how a saved LoRA acts, or that are used below. All others must be unset: they stand
# for other methods, or for parts of the fine-tune that are no low-rank change of a linear layer.
_KNOWN = {
    *("auto_mapping", "base_model_name_or_path", "revision", "peft_type", "task_type", "inference_mode"),
    *("peft_version", "r", "lora_alpha", "use_rslora", "rank_pattern", "lora_dropout", "target_modules"),
    *("exclude_modules", "layers_to_transform", "layers_pattern", "megatron_core", "runtime_config", "eva_config"),
    "qalora_group_size",
}
_INITIAL = (True, False, None, "gaussian", "orthogonal", "eva")  # others change the weights of the base as well


def base_of(folder: Path) -> str | None:
    """Return the checkpoint that the adapter's training names as its base; None if it names none."""
    named = _config(folder).get("base_model_name_or_path") or None
    if named is not None and not isinstance(named, str):
        raise ConfigError(
            f"{folder / CONFIG}: got {type(named).__name__} as base_model_name_or_path, want the name of a checkpoint"
        )
    return named


def read_adapter(folder: Path, network: Any) -> dict[str, tuple[Any, Any]]:
    """Read an adapter and check that it fits a network.

    Args:
        folder: A folder with `FILES`.
        network: The torch module that the adapter changes.

    Returns:
        For each layer that the adapter changes, by the name of its module: A (r, in), or (r, in, height, width) of a
        convolution, and scale * B (out, r), in the type and on the device of the layer's weights.

    Raises:
        ConfigError: It is no LoRA of linear layers and convolutions, is damaged, or does not fit the network.
    """
    config = _config(folder)
    saved = _tensors(folder / WEIGHTS)
    _require_complete(folder, saved, network)
    modules = dict(network.named_modules())
    names = [key.removeprefix(_PREFIX).removesuffix(_DOWN) for key in saved if key.endswith(_DOWN)]
    _require_adaptable(folder, names, modules)
    return {name: _layer(folder, name, saved, config, modules[name].weight) for name in names}


def _config(folder: Path) -> dict[str, Any]:
    try:
        config = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{folder / CONFIG}: cannot be read as JSON ({error}); copy it again") from error
    if not isinstance(config, dict) or config.get("peft_type") != "LORA":
        got = config.get("peft_type") if isinstance(config, dict) else type(config).__name__
        raise ConfigError(
            f"{folder / CONFIG}: got peft_type {got!r}, want 'LORA'; merge another kind into its base "
            f"(merge_and_unload) and serve that as a checkpoint of its own"
        )
    other = {name: value for name, value in config.items() if name not in _KNOWN and value and value != "none"}
    if config.get("init_lora_weights") in _INITIAL:
        other.pop("init_lora_weights", None)
    if other:
        raise ConfigError(
            f"{folder / CONFIG}: got {other}, want a plain LoRA of linear layers without these; merge the fine-tune "
            f"into its base (merge_and_unload) and serve that as a checkpoint of its own"
        )
    return config


def _tensors(file: Path) -> Mapping[str, Any]:
    try:
        with file.open("rb") as opened:
            length = opened.read(8)
            reader = ValuesReader(read_header(length + opened.read(struct.unpack("<Q", length)[0])))
            while part := opened.read(PART_BYTES):
                reader.add(part)
        if reader.received != reader.size:
            raise MalformedMessage(f"safetensors: got {reader.received} bytes of values, want {reader.size}")
        return reader.values()
    except (OSError, MalformedMessage, struct.error, OverflowError, MemoryError) as error:
        raise ConfigError(f"{file}: is damaged, or of another format ({error}); copy it again") from error


def _require_complete(folder: Path, saved: Mapping[str, Any], network: Any) -> None:
    """Raise `ConfigError` unless the file holds pairs of A and B, and otherwise only unchanged values of the network.

    PEFT saves the whole last layer of a language model as well if that has an adapter.
    """
    stems = {key.removesuffix(end) for key in saved for end in (_DOWN, _UP) if key.endswith(end)}
    wanted = {stem + end for stem in stems for end in (_DOWN, _UP)}
    faults = sorted({*wanted - set(saved), *(key for key in wanted if not key.startswith(_PREFIX))})
    held = network.state_dict() if set(saved) - wanted else {}
    for key in sorted(set(saved) - wanted):
        value = held.get(key.removeprefix(_PREFIX).replace(_BASE, "."))
        if value is None or saved[key].shape != tuple(value.shape) or not converted(saved[key], value).equal(value):
            faults.append(key)
    if faults or not wanted:
        raise ConfigError(
            f"{folder / WEIGHTS}: got {faults[:_LISTED] or 'no adapters'}, want pairs {_PREFIX}LAYER{_DOWN} and "
            f"{_PREFIX}LAYER{_UP}, and no changes of the base; merge another kind of fine-tune "
            f"into it (merge_and_unload)"
        )


def _require_adaptable(folder: Path, names: list[str], modules: Mapping[str, Any]) -> None:
    from torch.nn import Conv2d, Linear

    unknown = sorted(name for name in names if name not in modules)
    if unknown:
        raise ConfigError(
            f"{folder / WEIGHTS}: {len(unknown)} of its {len(names)} layers are not in the network: "
            f"{unknown[:_LISTED]}; want an adapter that was trained on this checkpoint, with this version of its code"
        )
    # not of a class derived from it: some, as in attention of torch, are never called, and only their weights are used
    other = {
        name: type(module).__name__
        for name, module in ((name, modules[name]) for name in sorted(names))
        if type(module) is not Linear
        and not (type(module) is Conv2d and module.groups == 1 and module.padding_mode == "zeros")
    }
    if other:
        raise ConfigError(
            f"{folder / WEIGHTS}: got adapters of {dict(list(other.items())[:_LISTED])}, want those of linear layers "
            f"and plain convolutions; merge this one into its base (merge_and_unload)"
        )


def _layer(
    folder: Path, name: str, saved: Mapping[str, Any], config: Mapping[str, Any], weight: Any
) -> tuple[Any, Any]:
    from torch import float32, isfinite

    raw = [saved[f"{_PREFIX}{name}{end}"] for end in (_DOWN, _UP)]
    if not all(one.dtype.kind in "fV" for one in raw):  # V: bfloat16, which numpy does not have
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: got A {raw[0].dtype} and B {raw[1].dtype}, want real numbers; save the "
            f"adapter without quantization"
        )
    # scaled before they are rounded to the type of the weights
    down, up = (converted(one, weight.new_empty(0, dtype=float32)) for one in raw)
    (outputs, *inputs), rank = weight.shape, down.shape[0] if down.ndim else 0
    wanted = (rank, *inputs), (outputs, rank, *(1 for _ in inputs[1:]))
    if (tuple(down.shape), tuple(up.shape)) != wanted or not rank:
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: got A {tuple(down.shape)} and B {tuple(up.shape)}, want them for weights "
            f"{tuple(weight.shape)}; want an adapter that was trained on this checkpoint"
        )
    alpha = config.get("lora_alpha")
    if isinstance(alpha, bool) or not isinstance(alpha, int | float) or not math.isfinite(alpha):
        raise ConfigError(f"{folder / CONFIG}: got lora_alpha {alpha!r}, want a number")
    scaled = up.flatten(1) * (alpha / (math.sqrt(rank) if config.get("use_rslora") else rank))
    down, scaled = down.to(weight.dtype), scaled.to(weight.dtype)
    if not (isfinite(down).all() and isfinite(scaled).all()):
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: got NaN or infinite values as {weight.dtype}, want finite ones; take an "
            f"earlier step of the training"
        )
    return down, scaled
