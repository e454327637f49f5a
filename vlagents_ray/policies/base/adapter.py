"""A LoRA adapter that is merged into the weights of a network when a policy is loaded.

The adapter is a folder of PEFT. For each layer that the adapter changes, the folder contains two
matrices A and B of a low rank, and the layer's weights W become W + scale * B A. The merged network
computes as many products as before, so it can be compiled, captured and quantized as any other.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError, MalformedMessage
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.checkpoint_files import digest
from vlagents_ray.weights.safetensors import read_values
from vlagents_ray.weights.trainable import converted

log = logging.getLogger(__name__)

CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
FILES = (CONFIG, WEIGHTS)
_PREFIX = "base_model.model."  # prefix of all names in the file
_DOWN, _UP = ".lora_A.weight", ".lora_B.weight"
_BASE = ".base_layer."  # part of the names of values in a layer with an adapter
_LISTED = 5
_HUB_ID = re.compile(r"[\w.-]+/[\w.-]+")
# Settings that do not change the effect of a saved LoRA, or that are used below. All other settings
# must be unset: they select other methods, or parts of the fine-tune that are not a low-rank change
# of a linear layer.
_KNOWN = {
    "auto_mapping",
    "base_model_name_or_path",
    "eva_config",
    "exclude_modules",
    "inference_mode",
    "layers_pattern",
    "layers_to_transform",
    "lora_alpha",
    "lora_dropout",
    "megatron_core",
    "peft_type",
    "peft_version",
    "qalora_group_size",
    "r",
    "rank_pattern",
    "revision",
    "runtime_config",
    "target_modules",
    "task_type",
    "use_rslora",
}
# Values of `init_lora_weights` that do not change the weights of the base.
_INITIAL = (True, False, None, "gaussian", "orthogonal", "eva")


@dataclass(frozen=True, slots=True)
class LoraAdapter:
    """A LoRA adapter in a folder of PEFT."""

    folder: Path
    config: dict[str, Any]  # the settings in the file `CONFIG`

    @classmethod
    def find(cls, source: str) -> LoraAdapter:
        """Find an adapter, which is downloaded if necessary, and read its settings.

        Args:
            source: The adapter's path or hub id, as for `find_checkpoint`.

        Raises:
            ConfigError: There is no such folder, a file is missing, or the adapter is not a plain
                LoRA.
        """
        folder = find_checkpoint(source, needs=FILES)
        if not folder.is_dir():
            raise ConfigError(
                f"{folder}: expected the folder with {', '.join(FILES)}, as PEFT saves it, got a "
                "file"
            )
        return cls(folder, _read_config(folder))

    def require_base(self, checkpoint: str, base: Sequence[Path]) -> None:
        """Check that the adapter was not trained on another base, as far as its settings name one.

        Args:
            checkpoint: The name of the policy's checkpoint, which is the base of the adapter.
            base: The files and folders of that checkpoint.

        Raises:
            ConfigError: The adapter was trained on another base.
        """
        trained_on = self.config.get("base_model_name_or_path") or None
        if trained_on is None:
            return
        if not isinstance(trained_on, str):
            raise ConfigError(
                f"{self.folder / CONFIG}: base_model_name_or_path: expected the name of a "
                f"checkpoint, got {type(trained_on).__name__}"
            )
        if _is_other(trained_on, checkpoint, base):
            raise ConfigError(
                f"{self.folder}: expected an adapter of {checkpoint!r}, the policy's checkpoint, "
                f"got one trained on {trained_on!r}; if these are the same weights, write that "
                "name as base_model_name_or_path in its adapter_config.json"
            )

    def merge_into(self, network: Any) -> None:
        """Add the adapter to the weights of a network, in place.

        If other modules use the same weights, as when the last layer of a language model is tied
        to its embeddings, the changed layer gets separate weights.

        Args:
            network: The torch module that the adapter changes.

        Raises:
            ConfigError: The adapter changes other layers than linear layers and convolutions, is
                damaged, or does not fit the network.
        """
        import torch

        modules = dict(network.named_modules())
        uses: Counter[int] = Counter()
        for module in modules.values():
            uses.update(map(id, module.parameters(recurse=False)))

        for name, (down, up, scale) in self._read(network, modules).items():
            module, weight = modules[name], modules[name].weight
            # The product is computed in the memory of the host, since products on an accelerator
            # may be less precise than float32.
            change = scale * (up.flatten(1) @ down.flatten(1)).view(weight.shape)
            merged = (weight.detach().float() + change.to(weight.device)).to(weight.dtype)
            if not merged.isfinite().all():
                raise ConfigError(
                    f"{self.folder / WEIGHTS}: {name}: expected values that are finite as "
                    f"{weight.dtype}, got NaN or infinity; use an earlier step of the training"
                )

            if uses[id(weight)] > 1:
                module.weight = torch.nn.Parameter(merged, requires_grad=weight.requires_grad)
            else:
                weight.data.copy_(merged)

    def _read(self, network: Any, modules: Mapping[str, Any]) -> dict[str, tuple[Any, Any, float]]:
        """Read the values of the adapter and check that they fit a network.

        Args:
            network: The torch module that the adapter changes.
            modules: Its modules by name.

        Returns:
            The name of each changed layer -> A, B and the scale of their product. A is (r, in), or
            (r, in, height, width) for a convolution. B is (out, r), or (out, r, 1, 1). A and B are
            float32 in the memory of the host.
        """
        try:
            with (self.folder / WEIGHTS).open("rb") as file:
                saved = read_values(file)
        except (OSError, MalformedMessage, MemoryError) as error:
            raise ConfigError(
                f"{self.folder / WEIGHTS}: is damaged, or has a different format ({error}); copy "
                "it again"
            ) from error

        _require_complete(self.folder, saved, network)
        names = [
            key.removeprefix(_PREFIX).removesuffix(_DOWN) for key in saved if key.endswith(_DOWN)
        ]
        _require_adaptable(self.folder, names, modules)
        return {name: self._layer(name, saved, modules[name].weight) for name in names}

    def _layer(self, name: str, saved: Mapping[str, Any], weight: Any) -> tuple[Any, Any, float]:
        """Return A, B and the scale of a layer, as `_read` does.

        Args:
            name: The name of the layer.
            saved: The values in the file of the adapter.
            weight: The weights of the layer.
        """
        from torch import empty, float32

        saved_down, saved_up = saved[f"{_PREFIX}{name}{_DOWN}"], saved[f"{_PREFIX}{name}{_UP}"]
        kinds = {saved_down.dtype.kind, saved_up.dtype.kind}
        if not kinds <= {"f", "V"}:  # "V" is bfloat16, which numpy does not have.
            raise ConfigError(
                f"{self.folder / WEIGHTS}: {name}: expected real numbers, got A "
                f"{saved_down.dtype} and B {saved_up.dtype}; save the adapter without quantization"
            )

        down = converted(saved_down, empty(0, dtype=float32))
        up = converted(saved_up, empty(0, dtype=float32))
        outputs, *inputs = weight.shape
        rank = down.shape[0] if down.ndim else 0
        down_shape = (rank, *inputs)
        up_shape = (outputs, rank, *(1 for _ in inputs[1:]))
        if (tuple(down.shape), tuple(up.shape)) != (down_shape, up_shape) or not rank:
            raise ConfigError(
                f"{self.folder / WEIGHTS}: {name}: expected A and B for weights of shape "
                f"{tuple(weight.shape)}, got A {tuple(down.shape)} and B {tuple(up.shape)}; use an "
                "adapter that was trained on this checkpoint"
            )

        alpha = self.config.get("lora_alpha")
        if (
            not isinstance(alpha, int | float)
            or isinstance(alpha, bool)
            or not math.isfinite(alpha)
        ):
            raise ConfigError(
                f"{self.folder / CONFIG}: lora_alpha: expected a number, got {alpha!r}"
            )
        scale = alpha / (math.sqrt(rank) if self.config.get("use_rslora") else rank)
        return down, up, scale


def _is_other(trained_on: str, checkpoint: str, base: Sequence[Path]) -> bool:
    """Return whether an adapter is known to have been trained on another base.

    Args:
        trained_on: The name of the base in the settings of the adapter.
        checkpoint: The name of the policy's checkpoint.
        base: The files and folders of that checkpoint.
    """
    # Unlike the methods of Path, functions of os.path raise no error for unknown users or for
    # unreadable folders.
    path = Path(os.path.expanduser(trained_on))
    if os.path.exists(path):
        folders_of_base: set[Path] = set()
        for base_path in base:
            folders_of_base |= {base_path.resolve(), *base_path.resolve().parents}
        return path.resolve() not in folders_of_base and digest([path]) != digest(base)

    names = [name.partition("@")[0] for name in (trained_on, checkpoint)]
    if all(_HUB_ID.fullmatch(name) for name in names) and not Path(checkpoint).exists():
        return names[0] != names[1]
    log.warning("adapter: the names do not show whether its base %r is the checkpoint %r", *names)
    return False


def _read_config(folder: Path) -> dict[str, Any]:
    """Return the settings of an adapter; raises `ConfigError` unless it is a plain LoRA."""
    try:
        config = json.loads((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{folder / CONFIG}: cannot be read as JSON ({error}); copy it again"
        ) from error

    if not isinstance(config, dict) or config.get("peft_type") != "LORA":
        kind = config.get("peft_type") if isinstance(config, dict) else type(config).__name__
        raise ConfigError(
            f"{folder / CONFIG}: peft_type: expected 'LORA', got {kind!r}; merge another type "
            "into its base (merge_and_unload) and serve that as a checkpoint of its own"
        )

    unsupported = {}
    for name, value in config.items():
        if name not in _KNOWN and value and value != "none":
            unsupported[name] = value
    if config.get("init_lora_weights") in _INITIAL:
        unsupported.pop("init_lora_weights", None)
    if unsupported:
        raise ConfigError(
            f"{folder / CONFIG}: expected a plain LoRA of linear layers, got {unsupported}; merge "
            "the fine-tune into its base (merge_and_unload) and serve that as a checkpoint of "
            "its own"
        )
    return config


def _require_complete(folder: Path, saved: Mapping[str, Any], network: Any) -> None:
    """Raise `ConfigError` unless a file contains pairs of A and B.

    The file may also contain values of the network if they are unchanged: if the last layer of a
    language model has an adapter, PEFT also saves the whole layer.
    """
    # Names of both A and B for each layer of which the file contains A or B.
    pairs: set[str] = set()
    for key in saved:
        for suffix in (_DOWN, _UP):
            if key.endswith(suffix):
                layer = key.removesuffix(suffix)
                pairs |= {layer + _DOWN, layer + _UP}
    misnamed = {key for key in pairs if not key.startswith(_PREFIX)}
    faults = sorted(pairs - set(saved) | misnamed)

    unpaired = sorted(set(saved) - pairs)
    base_values = network.state_dict() if unpaired else {}
    for key in unpaired:
        value = base_values.get(key.removeprefix(_PREFIX).replace(_BASE, "."))
        if value is None or not converted(saved[key], value).equal(value):
            faults.append(key)

    if faults or not pairs:
        raise ConfigError(
            f"{folder / WEIGHTS}: expected pairs {_PREFIX}LAYER{_DOWN} and {_PREFIX}LAYER{_UP}, "
            f"and no changes of the base, got {faults[:_LISTED] or 'no adapters'}; merge another "
            "type of fine-tune into the base (merge_and_unload)"
        )


def _require_adaptable(folder: Path, names: list[str], modules: Mapping[str, Any]) -> None:
    """Raise `ConfigError` unless an adapter changes only linear layers and plain convolutions."""
    unknown = sorted(name for name in names if name not in modules)
    if unknown:
        raise ConfigError(
            f"{folder / WEIGHTS}: expected layers of the network, got {len(unknown)} of "
            f"{len(names)} that it does not have: {unknown[:_LISTED]}; use an adapter that was "
            "trained on this checkpoint, with this version of its code"
        )

    unsupported = {}
    for name in sorted(names):
        if not _is_adaptable(modules[name]):
            unsupported[name] = type(modules[name]).__name__
    if unsupported:
        raise ConfigError(
            f"{folder / WEIGHTS}: expected adapters of linear layers and plain convolutions, got "
            f"{dict(list(unsupported.items())[:_LISTED])}; merge the fine-tune into its base "
            "(merge_and_unload)"
        )


def _is_adaptable(module: Any) -> bool:
    """Return whether a module is a linear layer or a plain convolution.

    Derived classes are excluded: some of them compute something else from their weights.
    """
    from torch.nn import Conv2d, Linear

    if type(module) is Linear:
        return True
    return type(module) is Conv2d and module.groups == 1 and module.padding_mode == "zeros"
