"""Random weights in safetensors files, written one tensor at a time.

A model on the device meta has names, shapes and types, but no values. Each tensor gets its values
when it is written, so that only one tensor is in memory.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

SHARD_BYTES = 5 * 10**9
_TYPES = {
    "float32": "F32",
    "bfloat16": "BF16",
    "float16": "F16",
    "int64": "I64",
    "int32": "I32",
    "bool": "BOOL",
}
_SPREAD = 0.1  # spread of scales around 1, and of biases around 0


@contextmanager
def parameters_on_meta() -> Iterator[None]:
    """Within the context, create parameters of modules without values. Buffers keep their values,
    which a checkpoint may lack.
    """
    module_class = require("torch").nn.Module
    parameter_class = require("torch").nn.Parameter
    register = module_class.register_parameter

    def registered(module: Any, name: str, parameter: Any) -> None:
        if parameter is not None and not parameter.is_meta:
            parameter = parameter_class(parameter.to("meta"), requires_grad=parameter.requires_grad)
        register(module, name, parameter)

    module_class.register_parameter = registered
    try:
        yield
    finally:
        module_class.register_parameter = register


def write_weights(
    model: Any,
    folder: Path,
    *,
    shard_bytes: int | None = SHARD_BYTES,
    changes: Mapping[str, Callable[[Any], None]] | None = None,
) -> int:
    """Write parameters and saved buffers of a model to `folder`, in their types.

    Args:
        model: The model. A tensor on the device meta gets random values; any other tensor keeps its
            values.
        folder: The folder for model.safetensors, or for several shards and their index if the model
            is larger.
        shard_bytes: The maximum size of a shard, unless a single tensor is larger; None writes
            everything into one file.
        changes: Functions by the name of a tensor that change its values before they are written.

    Returns:
        The number of parameters; a parameter with several names counts once, and is written under
        its first name.

    Raises:
        ConfigError: The disk has too little space.
    """
    tensors = _tensors(model)
    shards: list[list[str]] = [[]]
    filled = 0
    for name, tensor in tensors.items():
        if shards[-1] and shard_bytes is not None and filled + _size(tensor) > shard_bytes:
            shards.append([])
            filled = 0
        shards[-1].append(name)
        filled += _size(tensor)
    total, free = sum(map(_size, tensors.values())), shutil.disk_usage(folder).free
    if total > free:
        raise ConfigError(
            f"{folder}: expected {total / 1e9:.1f} GB, got {free / 1e9:.1f} GB of free space"
        )
    files = _file_names(len(shards))
    generator = require("torch").Generator().manual_seed(0)
    for file, names in zip(files, shards, strict=True):
        _write_file(
            folder / file, {name: tensors[name] for name in names}, generator, changes or {}
        )
    if len(files) > 1:
        places = {name: file for file, names in zip(files, shards, strict=True) for name in names}
        index = {"metadata": {"total_size": total}, "weight_map": places}
        (folder / "model.safetensors.index.json").write_text(json.dumps(index, indent=2))
    return sum({id(parameter): parameter.numel() for parameter in model.parameters()}.values())


def fill(tensor: Any, name: str, generator: Any) -> None:
    """Fill a tensor with random values that preserve the scale of activations: 1 / sqrt(inputs)
    for a matrix.
    """
    if not tensor.is_floating_point():
        tensor.zero_()
        return
    reach = math.sqrt(3 / max(1, tensor[0].numel())) if tensor.ndim > 1 else _SPREAD
    tensor.uniform_(-reach, reach, generator=generator)
    if tensor.ndim <= 1 and not name.endswith("bias"):  # scales of norms and layers
        tensor.add_(1)


def _tensors(model: Any) -> dict[str, Any]:
    found: dict[int, tuple[str, Any]] = {}
    for name, tensor in model.state_dict(keep_vars=True).items():
        found.setdefault(id(tensor), (name, tensor))
    # Tensors of the widest types come first, so that each tensor begins at a multiple of its type's
    # size.
    return dict(sorted(found.values(), key=lambda one: -one[1].element_size()))


def _size(tensor: Any) -> int:
    return int(tensor.numel() * tensor.element_size())


def _file_names(count: int) -> list[str]:
    if count == 1:
        return ["model.safetensors"]
    return [f"model-{number:05d}-of-{count:05d}.safetensors" for number in range(1, count + 1)]


def _write_file(
    path: Path,
    tensors: Mapping[str, Any],
    generator: Any,
    changes: Mapping[str, Callable[[Any], None]],
) -> None:
    """Write a safetensors file: 8 bytes with the length of the header, the header (JSON), and
    the tensors' bytes.
    """
    torch = require("torch")
    header: dict[str, Any] = {"__metadata__": {"format": "pt"}}
    end = 0
    for name, tensor in tensors.items():
        begin, end = end, end + _size(tensor)
        kind = _TYPES[str(tensor.dtype).removeprefix("torch.")]
        header[name] = {"dtype": kind, "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name, tensor in tensors.items():
            if tensor.is_meta:
                values = torch.empty(tensor.shape, dtype=tensor.dtype)
                fill(values, name, generator)
            else:
                values = tensor.detach().clone()
            changes.get(name, lambda _: None)(values)
            values.contiguous().reshape(-1).view(torch.uint8).numpy().tofile(file)
