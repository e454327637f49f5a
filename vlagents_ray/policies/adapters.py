"""LoRA adapters of one network, with a separate adapter for each row of a batch.

The weights of the network are not changed. After each linear layer that an adapter changes, a hook
adds B[i] A[i] x to the layer's result, where i is the adapter of x's row. This takes two small
products for all rows of the batch, since one tensor contains the A of all adapters and another
tensor contains the B of all adapters. Adapters of a smaller rank are padded with zeros, and rows
without an adapter use an adapter of zeros. S-LoRA (arXiv 2311.03285) and Punica (arXiv 2310.18547)
serve language models in this way.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    PolicyFailed,
    UnknownCheckpoint,
    UnknownSession,
)
from vlagents_ray.interface import POLICY
from vlagents_ray.weights.safetensors import read_values
from vlagents_ray.weights.trainable import converted

ADAPTER = "adapter"  # option of a reset: the name of the session's adapter
DIGITS = 16  # number of hexadecimal digits in the fingerprint of a checkpoint


@dataclass(frozen=True, slots=True)
class LoraAdapter:
    """The adapter of a session; by default, no adapter."""

    source: str = ""  # path or hub id, as in the settings
    weights: str = ""  # SHA-256 of the base's files and the adapter's
    # The first digits of `weights`; empty if the session uses the base checkpoint alone.
    fingerprint: str = ""
    revision: str | None = None  # commit of the adapter on the hub

    @property
    def identity(self) -> dict[str, Any]:
        """The checkpoint, digest and commit, for the info of a reset.

        It is empty without an adapter.
        """
        if not self.fingerprint:
            return {}
        return {"checkpoint": self.source, "weights": self.weights, "revision": self.revision}


# Index of the adapter of each row in this thread's forward pass, int64; None if no row has an
# adapter.
_CHOSEN: ContextVar[Any] = ContextVar("chosen adapters", default=None)


class _Values(dict[str, Any]):
    """The values of one adapter by their names in its file, float32 in the memory of the host.

    Setting a value also writes the rounded value into the tensors that the forward passes read.
    """

    def __init__(self, index: int) -> None:
        self.index = index  # index of the adapter in the tensors of all adapters
        self.pushed: set[str] = set()  # names whose values a learner has pushed
        self._targets: dict[str, tuple[Any, Any, float]] = {}

    def read(self, name: str, value: Any, target: Any, scale: float) -> None:
        """Set a value that was read from the file.

        Args:
            name: The name in the file.
            value: The value.
            target: The tensor into which this value, and each later value that replaces it, is
                written.
            scale: The factor by which a value is multiplied before it is written.
        """
        self._targets[name] = value, target, scale
        self[name] = value

    def __setitem__(self, name: str, value: Any) -> None:
        if value is self.get(name):
            return

        value_of_file, target, scale = self._targets[name]
        target.copy_(value.reshape(target.shape) * scale)
        if value is value_of_file:
            self.pushed.discard(name)
        else:
            self.pushed.add(name)
        super().__setitem__(name, value)


class LoraAdapters:
    """The adapters of one network."""

    def __init__(self) -> None:
        self.base = ""  # fingerprint of the base without an adapter
        # Values of the base that are in the memory of the host while the policy sleeps.
        self.moved: list[tuple[Any, Any]] = []
        self._by_name: dict[str, LoraAdapter] = {}  # name in resets -> adapter
        # Fingerprint -> values. The base has index 0, whose values are zeros.
        self._values = {"": _Values(0)}
        self._device: Any = None

    @property
    def ids(self) -> dict[str, str]:
        """The digest of each adapter together with its base.

        The keys are the names used in resets.
        """
        return {name: adapter.weights for name, adapter in self._by_name.items()}

    @property
    def trainable(self) -> dict[str, dict[str, Any]]:
        """The values of each adapter by their names in its file.

        Replacing a value changes the actions.
        """
        return {name: self._values[adapter.fingerprint] for name, adapter in self._by_name.items()}

    def load(
        self,
        network: Any,
        sources: Mapping[str, str],
        find: Callable[[str], tuple[LoraAdapter, Path]],
        adapt: Callable[[str, Path], None],
    ) -> None:
        """Read adapters, and make the network's layers apply them.

        Args:
            network: The torch module.
            sources: Name in resets -> path or hub id of the adapter.
            find: A function that returns the adapter at a source, and its folder.
            adapt: A function that is called with the fingerprint and the folder of each adapter.

        Raises:
            ConfigError: An adapter does not fit the network.
        """
        import torch

        # Layer -> fingerprint -> A, B and scale.
        layers: dict[str, dict[str, tuple[Any, Any, float]]] = {}
        for name, source in sources.items():
            try:
                adapter, folder = find(source)
                self._values.setdefault(adapter.fingerprint, _Values(len(self._values)))
                for layer, change in read_adapter(folder, network).items():
                    layers.setdefault(layer, {})[adapter.fingerprint] = change
                adapt(adapter.fingerprint, folder)
            except ConfigError as error:
                raise ConfigError(f"adapter {name!r}: {error}") from error
            self._by_name[name] = adapter

        count = len(self._values)
        modules = dict(network.named_modules())
        for layer, changes in layers.items():
            weight = modules[layer].weight
            outputs, *inputs = weight.shape
            rank = max(len(down) for down, _, _ in changes.values())
            like_weight = {"dtype": weight.dtype, "device": weight.device}
            downs = torch.zeros(count, rank, *inputs, **like_weight)
            ups = torch.zeros(count, outputs, rank, **like_weight)

            for fingerprint, (down, up, scale) in changes.items():
                values = self._values[fingerprint]
                down_target = downs[values.index, : len(down)]
                up_target = ups[values.index, :, : len(down)]
                values.read(f"{_PREFIX}{layer}{_DOWN}", down, down_target, 1.0)
                values.read(f"{_PREFIX}{layer}{_UP}", up, up_target, scale)

            modules[layer].register_forward_hook(partial(self._add, downs, ups))
            self._device = weight.device

    def find(self, name: object) -> LoraAdapter:
        """Return the adapter with a name, or an empty one for None.

        Raises:
            UnknownCheckpoint: There is no adapter with this name.
        """
        if name is None:
            return LoraAdapter()
        if not isinstance(name, str) or name not in self._by_name:
            raise UnknownCheckpoint(
                f"{ADAPTER}: expected one of {sorted(self._by_name)}, or none for the base, got "
                f"{name!r}"
            )
        return self._by_name[name]

    def example(self, number: int) -> str:
        """Return the fingerprint of an adapter for an example row.

        Successive numbers select different adapters.
        """
        return list(self._values)[(number + 1) % len(self._values)]

    def require(self, fingerprint: str) -> str:
        """Return a fingerprint if the adapter with this fingerprint is loaded.

        Raises:
            UnknownSession: The adapter of a moved session is not loaded in this replica.
        """
        if fingerprint not in self._values:
            raise UnknownSession(f"its adapter {fingerprint} is not loaded here; reset the session")
        return fingerprint

    def weights_info(self, fingerprint: str) -> dict[str, Any]:
        """Return the info about the weights of an answer, as long as no push has changed any
        weights.

        After a push, the info is empty, and the server reports the learner's version instead. That
        version covers all adapters, and a replica that starts later receives all of them.
        """
        if fingerprint and any(values.pushed for values in self._values.values()):
            return {}

        fingerprint = fingerprint or self.base
        return {POLICY: {"version": 0, "fingerprint": fingerprint}} if fingerprint else {}

    @contextmanager
    def rows(self, fingerprints: Iterable[str]) -> Iterator[None]:
        """Within the context, apply an adapter to each row of the network's forward passes on this
        thread.

        Args:
            fingerprints: The adapter of each row; empty for rows without an adapter.
        """
        indices = [self._values[fingerprint].index for fingerprint in fingerprints]
        chosen = None
        if any(indices):
            import torch

            chosen = torch.tensor(indices).to(self._device, non_blocking=True)

        token = _CHOSEN.set(chosen)
        try:
            yield
        finally:
            _CHOSEN.reset(token)

    def _add(self, downs: Any, ups: Any, module: Any, inputs: tuple[Any, ...], output: Any) -> Any:
        """Add the change of each row's adapter to the output of a layer.

        This is a forward hook. The first dimension of the output has the same number of entries for
        each row.
        """
        chosen = _CHOSEN.get()
        if chosen is None:
            return output

        [x] = inputs
        if len(x) % len(chosen):
            raise PolicyFailed(
                f"adapters: expected an entry of the layer's input for each of {len(chosen)} "
                f"rows, got {len(x)}"
            )
        if downs.ndim == 3:
            entries = x.reshape(len(chosen), -1, x.shape[-1])
            change = (entries @ downs[chosen].mT) @ ups[chosen].mT
        else:
            chosen_by_entry = chosen.repeat_interleave(len(x) // len(chosen))
            change = _convolved(module, x, downs, ups, chosen_by_entry)
        return output + change.view(output.shape).to(output.dtype)


def _convolved(module: Any, x: Any, downs: Any, ups: Any, chosen: Any) -> Any:
    """Return the change that the adapter of each entry adds to a convolution's output.

    The entries are the groups of one convolution. Its other settings are the settings of the
    module.

    Args:
        module: The convolution.
        x: Its input, (N, in, H, W).
        downs: The matrix A of each of n adapters, (n, r, in, h, w).
        ups: The matrix B of each adapter, (n, out, r).
        chosen: The index of the adapter of each entry, (N,).
    """
    from torch.nn.functional import conv2d

    low_rank = conv2d(
        x.flatten(0, 1)[None],
        downs[chosen].flatten(0, 1),
        None,
        module.stride,
        module.padding,
        module.dilation,
        groups=len(x),
    )
    return ups[chosen] @ low_rank.view(len(x), downs.shape[1], -1)


CONFIG, WEIGHTS = "adapter_config.json", "adapter_model.safetensors"
FILES = (CONFIG, WEIGHTS)
_PREFIX = "base_model.model."  # prefix of all names in the file
_DOWN, _UP = ".lora_A.weight", ".lora_B.weight"
_BASE = ".base_layer."  # part of the names of values in a layer with an adapter
_LISTED = 5
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


def base_of(folder: Path) -> str | None:
    """Return the checkpoint on which an adapter was trained; None if the adapter's settings do
    not name it.
    """
    base = _config(folder).get("base_model_name_or_path") or None
    if base is not None and not isinstance(base, str):
        raise ConfigError(
            f"{folder / CONFIG}: base_model_name_or_path: expected the name of a checkpoint, got "
            f"{type(base).__name__}"
        )
    return base


def read_adapter(folder: Path, network: Any) -> dict[str, tuple[Any, Any, float]]:
    """Read an adapter and check that it fits a network.

    Args:
        folder: A folder with `FILES`.
        network: The torch module that the adapter changes.

    Returns:
        The name of the module of each changed layer -> A, B and the scale of B. A is (r, in), or
        (r, in, height, width) for a convolution. B is (out, r), or (out, r, 1, 1). A and B are
        float32 in the memory of the host.

    Raises:
        ConfigError: The adapter is not a LoRA of linear layers and convolutions, is damaged, or
            does not fit the network.
    """
    config = _config(folder)
    try:
        with (folder / WEIGHTS).open("rb") as file:
            saved = read_values(file)
    except (OSError, MalformedMessage, MemoryError) as error:
        raise ConfigError(
            f"{folder / WEIGHTS}: is damaged, or has a different format ({error}); copy it again"
        ) from error

    _require_complete(folder, saved, network)
    modules = dict(network.named_modules())
    names = [key.removeprefix(_PREFIX).removesuffix(_DOWN) for key in saved if key.endswith(_DOWN)]
    _require_adaptable(folder, names, modules)
    return {name: _layer(folder, name, saved, config, modules[name].weight) for name in names}


def _config(folder: Path) -> dict[str, Any]:
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
        has_same_shape = value is not None and saved[key].shape == tuple(value.shape)
        if not has_same_shape or not converted(saved[key], value).equal(value):
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

    Derived classes are excluded: modules of some derived classes, such as those in torch's
    attention, are never called, and only their weights are read.
    """
    from torch.nn import Conv2d, Linear

    if type(module) is Linear:
        return True
    return type(module) is Conv2d and module.groups == 1 and module.padding_mode == "zeros"


def _layer(
    folder: Path, name: str, saved: Mapping[str, Any], config: Mapping[str, Any], weight: Any
) -> tuple[Any, Any, float]:
    """Return A, B and the scale of a layer, as `read_adapter` does.

    Args:
        folder: The folder of the adapter, for errors.
        name: The name of the layer's module.
        saved: The values in the file of the adapter.
        config: The settings of the adapter.
        weight: The weights of the layer.
    """
    from torch import empty, float32

    saved_down, saved_up = saved[f"{_PREFIX}{name}{_DOWN}"], saved[f"{_PREFIX}{name}{_UP}"]
    kinds = {saved_down.dtype.kind, saved_up.dtype.kind}
    if not kinds <= {"f", "V"}:  # "V" is bfloat16, which numpy does not have.
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: expected real numbers, got A {saved_down.dtype} and B "
            f"{saved_up.dtype}; save the adapter without quantization"
        )

    # B is float32, since it is scaled before it is rounded to the type of the weights.
    down = converted(saved_down, empty(0, dtype=float32))
    up = converted(saved_up, empty(0, dtype=float32))
    outputs, *inputs = weight.shape
    rank = down.shape[0] if down.ndim else 0
    down_shape = (rank, *inputs)
    up_shape = (outputs, rank, *(1 for _ in inputs[1:]))
    if (tuple(down.shape), tuple(up.shape)) != (down_shape, up_shape) or not rank:
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: expected A and B for weights of shape "
            f"{tuple(weight.shape)}, got A {tuple(down.shape)} and B {tuple(up.shape)}; use an "
            "adapter that was trained on this checkpoint"
        )

    alpha = config.get("lora_alpha")
    if isinstance(alpha, bool) or not isinstance(alpha, int | float) or not math.isfinite(alpha):
        raise ConfigError(f"{folder / CONFIG}: lora_alpha: expected a number, got {alpha!r}")
    scale = alpha / (math.sqrt(rank) if config.get("use_rslora") else rank)
    if not all(values.to(weight.dtype).isfinite().all() for values in (down, up * scale)):
        raise ConfigError(
            f"{folder / WEIGHTS}: {name}: expected values that are finite as {weight.dtype}, got "
            "NaN or infinity; use an earlier step of the training"
        )
    return down, up, scale
