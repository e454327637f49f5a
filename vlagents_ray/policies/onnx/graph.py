"""The file of an exported policy: an ONNX graph by ONNX Runtime, or a TorchScript archive by torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.accelerator import fetch, onnx_provider, torch_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.onnx.config import OnnxConfig
from vlagents_ray.registry import require

TOKENIZER = "tokenizer.json"
_TORCHSCRIPT = (".pt", ".pth", ".jit")
_TYPES = {"float": "float32", "double": "float64", "string": "object"}  # those that numpy names otherwise

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Tensor:
    """An input of a graph."""

    shape: tuple[int, ...]  # -1: the batch
    dtype: np.dtype[Any]

    @cached_property
    def axis(self) -> int | None:
        """The dimension of the batch; None if there is one row."""
        return self.shape.index(-1) if -1 in self.shape else None

    @cached_property
    def row(self) -> tuple[int, ...]:
        """The shape with a batch of one."""
        return tuple(abs(length) for length in self.shape)

    @cached_property
    def size(self) -> int:
        """How many numbers a row has."""
        return prod(self.row)

    def zeros(self) -> np.ndarray:
        return np.full(self.row, "" if self.dtype == object else 0, self.dtype)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Return a row of numbers in [0, 1)."""
        return self.zeros() if self.dtype == object else rng.random(self.row).astype(self.dtype)


class OnnxGraph:
    """The graph of an ONNX file, which ONNX Runtime computes."""

    def __init__(self, path: Path, config: OnnxConfig) -> None:
        runtime = require("onnxruntime")
        provider, settings = onnx_provider(config.device, config.matmul)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = config.threads
        options.use_deterministic_compute = True
        options.log_severity_level = 3  # errors: it warns of each unused weight that an exporter left
        try:
            self._session = runtime.InferenceSession(str(path), options, providers=[(provider, settings)])
        except Exception as error:
            raise ConfigError(f"checkpoint {path}: ONNX Runtime cannot read it: {first_line(error)}") from error
        if provider not in self._session.get_providers():  # it only warns, and would compute on the CPU
            raise ConfigError(
                f"device {config.device!r}: {provider} did not start, as the log says; install the CUDA and cuDNN that "
                f"this onnxruntime-gpu needs, or set device: cpu with resources: {{num_gpus: 0}}"
            )
        self.outputs: list[str] = [one.name for one in self._session.get_outputs()]
        self.inputs: dict[str, Tensor] = {}
        for one in self._session.get_inputs():
            kind = one.type.removeprefix("tensor(").removesuffix(")")
            stated = [length if isinstance(length, int) else -1 for length in one.shape]
            self.inputs[one.name] = Tensor(_shape(one.name, stated, config), np.dtype(_TYPES.get(kind, kind)))

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        return dict(zip(self.outputs, self._session.run(None, feeds), strict=True))


class TorchScript:
    """An archive of `torch.jit.save`, whose inputs are the arguments of `forward`, float32."""

    def __init__(self, path: Path, config: OnnxConfig) -> None:
        torch = require("torch")
        self._device, self.outputs = torch_device(config.device), config.outputs
        try:
            self._module = torch.jit.load(str(path), map_location=self._device).eval()
            names = [one.name for one in self._module.forward.schema.arguments[1:]]
        except (RuntimeError, AttributeError, ValueError) as error:
            raise ConfigError(f"checkpoint {path}: torch.jit.load cannot read it: {first_line(error)}") from error
        self.inputs = {name: Tensor(_shape(name, None, config), np.dtype(np.float32)) for name in names}

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        torch = require("torch")
        with torch.inference_mode():
            found = self._module(*(torch.from_numpy(feeds[name]).to(self._device) for name in self.inputs))
        found = found if isinstance(found, tuple | list) else (found,)
        if len(found) != len(self.outputs):
            raise ConfigError(f"outputs: got {self.outputs}, want names for the {len(found)} results of `forward`")
        return {name: fetch(one.float()) for name, one in zip(self.outputs, found, strict=True)}


def read_graph(config: OnnxConfig) -> tuple[OnnxGraph | TorchScript, Path]:
    """Read the checkpoint.

    Returns:
        The graph, and its file.

    Raises:
        ConfigError: The checkpoint is not one such file, is not trusted, or cannot be read.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step)
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    found = [file for file in files if file.suffix in (".onnx", *_TORCHSCRIPT)]
    if len(found) != 1:
        raise ConfigError(
            f"checkpoint {path}: got {[one.name for one in found or files][:10]}, want one file with the suffix .onnx "
            f"or {', '.join(_TORCHSCRIPT)}; name that file"
        )
    [file] = found
    if path == file:  # the parts beside it count for its digest, too: weights of a large graph, the tokenizer
        for pattern in (f"{file.name}[._]*", TOKENIZER):
            for part in file.parent.glob(pattern):
                find_checkpoint(str(part))
    if file.suffix == ".onnx":
        return OnnxGraph(file, config), file
    if not config.trust_checkpoint:
        raise ConfigError(
            f"checkpoint {file}: a TorchScript archive is a program, which can also read and write files; set "
            f"trust_checkpoint: true if you trust its author, or export it as ONNX"
        )
    return TorchScript(file, config), file


def first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _shape(name: str, stated: Sequence[int] | None, config: OnnxConfig) -> tuple[int, ...]:
    """Return the shape of an input, of which the file states what is not -1."""
    given = config.inputs[name].shape if name in config.inputs else None
    shape = stated if given is None else given
    if shape is None or shape.count(-1) > 1:
        raise ConfigError(
            f"inputs: {name}: shape: got {given}, the file states {stated or 'none'}, want all lengths that the policy "
            f"was trained with, and -1 for the batch, such as [-1, 48]"
        )
    return tuple(shape)
