"""Exported policies of any kind, as ONNX files or TorchScript archives.

A deployment file declares the source of each input and the meaning of the outputs. Each session has
its own recurrent state, and all sessions share a batch.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, Field, PrivateAttr, model_validator
from typing_extensions import Self

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, MalformedMessage
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import fetch, onnx_provider, torch_device
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    needs_gripper,
    resize_with_pad,
    state_specs,
    state_vector,
)
from vlagents_ray.registry import require

log = logging.getLogger(__name__)

Numbers = float | list[float]
SOURCES = ("state", "constant", "step", "noise", "instruction")  # fields of `Input`


class Scaling(BaseModel, extra="forbid"):
    """The conversion of the robot's numbers to the model's numbers, (x - mean) / std, and the
    inverse conversion for actions.
    """

    mean: Numbers | dict[str, Numbers] = Field(
        default=0.0,
        description="one number for all, a list, or either by part of the state; for an action, "
        "its offset",
    )
    std: Numbers | dict[str, Numbers] = Field(
        default=1.0, description="as `mean`; for an action, its scale"
    )
    min: Numbers | dict[str, Numbers] | None = Field(
        default=None, description="with `max`: the number that becomes -1 in the model"
    )
    max: Numbers | dict[str, Numbers] | None = Field(
        default=None, description="with `min`: the number that becomes 1 in the model"
    )
    clip: tuple[float, float] | None = Field(
        default=None, description="limits of the model's numbers"
    )
    # Cached mean and std of each part of the state, float32.
    _arrays: dict[str, tuple[Any, Any]] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _one_pair(self) -> Self:
        if (self.min is None) != (self.max is None) or (
            self.min is not None and {"mean", "std"} & self.model_fields_set
        ):
            raise ValueError(
                "expected min and max, or mean and std, or neither pair, got "
                f"{sorted(self.model_fields_set)}; leave one pair out"
            )
        return self

    @property
    def parts(self) -> set[str]:
        """The parts of the state that have separate statistics."""
        parts: set[str] = set()
        for statistic in (self.mean, self.std, self.min, self.max):
            if isinstance(statistic, dict):
                parts.update(statistic)
        return parts

    def normalized(self, values: np.ndarray, part: str = "") -> np.ndarray:
        """Convert the robot's numbers to the model's.

        Args:
            values: The robot's numbers, (..., D) float32.
            part: The part of the state to which the values belong.

        Returns:
            The model's numbers, (..., D).
        """
        if self.model_fields_set & {"mean", "std", "min"}:
            mean, std = self._mean_and_std(part)
            values = (values - mean) / std
        return values if self.clip is None else values.clip(*self.clip)

    def unnormalized(self, values: np.ndarray) -> np.ndarray:
        """Convert the model's numbers, (..., D) float32, to the robot's numbers."""
        mean, std = self._mean_and_std()
        restored: np.ndarray = values * std + mean
        return restored

    def _mean_and_std(self, part: str = "") -> tuple[Any, Any]:
        if part not in self._arrays:
            if self.min is None:
                mean = _statistic(self.mean, part, 0.0)
                std = _statistic(self.std, part, 1.0)
            else:
                low = _statistic(self.min, part, -1.0)
                high = _statistic(self.max, part, 1.0)
                mean, std = (high + low) / 2, (high - low) / 2
            self._arrays[part] = mean, std
        return self._arrays[part]


def _statistic(setting: Any, part: str, default: float) -> Any:
    """Return a statistic of a part of the state as an array, float32."""
    value = setting.get(part, default) if isinstance(setting, dict) else setting
    return np.asarray(value, np.float32)


class Input(Scaling):
    """Settings of one input of the file: its conversion, and its source if the source is neither a
    camera nor the whole state.
    """

    state: list[str] | None = Field(
        default=None, description="as the policy's `state`, for one of several vectors"
    )
    constant: float | list[Any] | None = Field(
        default=None, description="the same numbers in each call"
    )
    step: float | None = Field(
        default=None, description="a counter of the session's passes, which begins with this number"
    )
    noise: Literal[True] | None = Field(
        default=None, description="standard normal numbers, drawn from the session's seed"
    )
    instruction: Literal["text", "tokens", "mask"] | None = Field(
        default=None,
        description="the instruction as a string, or its token ids from the tokenizer.json next to "
        "the file, or the mask of these ids",
    )
    history: int = Field(
        default=1, ge=1, description="how many of the last observations it contains, oldest first"
    )
    shape: list[int] | None = Field(
        default=None,
        description="for a file that leaves lengths open, as all TorchScript does; -1 is the batch",
    )
    range: tuple[float, float] = Field(
        default=(0.0, 1.0), description="the range of an image that is not uint8"
    )
    resize: bool = Field(
        default=False, description="accept images of any size, and pad them with black"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = [name for name in SOURCES if getattr(self, name) is not None]
        if len(sources) > 1:
            raise ValueError(
                f"expected one source of an input, got {sources}; leave the others out"
            )
        return self


class Action(Scaling):
    """The output that contains the action, and its conversion: the action is offset (`mean`) plus
    scale (`std`) times the output.
    """

    output: str | None = Field(
        default=None,
        description="name of the output; unset: the only one that no other setting names",
    )


class OnnxConfig(ModelConfig):
    """Settings of an exported policy, in addition to the settings of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="an .onnx file or a TorchScript archive (.pt, .jit), or a folder or hub id "
        "(org/name@COMMIT) with one; `{step}` stands for checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False,
        description="a TorchScript archive is a program: set true if you trust its author",
    )
    dtype: Literal["auto"] = Field(default="auto", description="as in the file")
    compile: Literal[False, "auto"] = Field(
        default="auto", description="nothing to compile: the runtime optimises the file"
    )
    threads: int = Field(
        default=1, ge=0, description="threads of ONNX Runtime on a CPU; 0: the runtime decides"
    )

    cameras: dict[str, str] | None = Field(
        default=None, description="each input that is an image -> your camera"
    )
    state: list[str] | None = Field(
        default=None,
        description="parts of the one input that no other setting names, in their order; "
        "'previous_output' is the last action before offset and scale, zeros at first",
    )
    inputs: dict[str, Input] = Field(
        default={}, description="the source and the conversion of an input, by its name"
    )
    recurrent: dict[str, str] = Field(
        default={}, description="each input that is a later output -> that output"
    )
    outputs: list[str] = Field(
        default=["action"], description="names for a TorchScript archive's results, in order"
    )
    action: Action = Field(
        default=Action(), description="which output is the action, its offset and its scale"
    )
    info: list[str] = Field(default=[], description="outputs that a call returns in its info")
    contract: dict[str, Any] = Field(
        default={},
        description="facts that the file lacks: {control_hz: 50, action: {space: joint, delta: "
        "false}}",
    )
    burn_in: int = Field(
        default=32,
        ge=1,
        le=256,
        description="how many of the last observations a recurrent state is computed from again if "
        "the session's replica is lost",
    )


TOKENIZER = "tokenizer.json"
_TORCHSCRIPT = (".pt", ".pth", ".jit")
# ONNX's name of a type -> numpy's name, where they differ.
_TYPES = {"float": "float32", "double": "float64", "string": "object"}

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Tensor:
    """An input of a graph."""

    shape: tuple[int, ...]  # lengths of the dimensions; -1 is the batch
    dtype: np.dtype[Any]

    @cached_property
    def batch_axis(self) -> int | None:
        """The index of the batch dimension; None if the input always has one row."""
        return self.shape.index(-1) if -1 in self.shape else None

    @cached_property
    def row_shape(self) -> tuple[int, ...]:
        """The shape with a batch of one."""
        return tuple(abs(length) for length in self.shape)

    @cached_property
    def size(self) -> int:
        """The number of values in a row."""
        return prod(self.row_shape)

    def zeros(self) -> np.ndarray:
        """Return a row of zeros, or of empty strings."""
        return np.full(self.row_shape, "" if self.dtype == object else 0, self.dtype)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Return a row of numbers in [0, 1), or of empty strings."""
        if self.dtype == object:
            return self.zeros()
        return rng.random(self.row_shape).astype(self.dtype)


class OnnxGraph:
    """The graph of an ONNX file, executed with ONNX Runtime."""

    def __init__(self, path: Path, config: OnnxConfig) -> None:
        runtime = require("onnxruntime")
        provider, settings = onnx_provider(config.device, config.matmul)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = config.threads
        options.use_deterministic_compute = True
        # Only errors are logged, since there would be a warning for each unused weight that an
        # exporter left in the file.
        options.log_severity_level = 3
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=[(provider, settings)]
            )
        except Exception as error:
            raise ConfigError(
                f"checkpoint {path}: ONNX Runtime cannot read it: {_first_line(error)}"
            ) from error
        # ONNX Runtime only logs a warning in this case, and would compute on the CPU.
        if provider not in self._session.get_providers():
            raise ConfigError(
                f"device {config.device!r}: {provider} did not start, as the log says; install the "
                "CUDA and cuDNN that this onnxruntime-gpu needs, or set device: cpu with "
                "resources: {num_gpus: 0}"
            )

        self.outputs: list[str] = [output.name for output in self._session.get_outputs()]
        self.inputs: dict[str, Tensor] = {}
        for graph_input in self._session.get_inputs():
            name = graph_input.name
            onnx_type = graph_input.type.removeprefix("tensor(").removesuffix(")")
            dtype = np.dtype(_TYPES.get(onnx_type, onnx_type))
            # An open length is a name or None.
            lengths = [length if isinstance(length, int) else -1 for length in graph_input.shape]
            self.inputs[name] = Tensor(_shape(name, lengths, config), dtype)

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        """Return all outputs by name, from all inputs by name."""
        return dict(zip(self.outputs, self._session.run(None, feeds), strict=True))


class TorchScript:
    """An archive of `torch.jit.save`. Its inputs are the arguments of `forward`, float32."""

    def __init__(self, path: Path, config: OnnxConfig) -> None:
        torch = require("torch")
        self._device = torch_device(config.device)
        self.outputs = config.outputs
        try:
            self._module = torch.jit.load(str(path), map_location=self._device).eval()
            arguments = self._module.forward.schema.arguments[1:]  # all arguments except `self`
        except (RuntimeError, AttributeError, ValueError) as error:
            raise ConfigError(
                f"checkpoint {path}: torch.jit.load cannot read it: {_first_line(error)}"
            ) from error

        self.inputs: dict[str, Tensor] = {}
        for argument in arguments:
            shape = _shape(argument.name, None, config)
            self.inputs[argument.name] = Tensor(shape, np.dtype(np.float32))

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        """Return all outputs by name, from all inputs by name."""
        torch = require("torch")
        with torch.inference_mode():
            args = [torch.from_numpy(feeds[name]).to(self._device) for name in self.inputs]
            returned = self._module(*args)
        results = returned if isinstance(returned, tuple | list) else (returned,)
        if len(results) != len(self.outputs):
            raise ConfigError(
                f"outputs: expected names for the {len(results)} results of `forward`, got "
                f"{self.outputs}"
            )
        return {
            name: fetch(result.float()) for name, result in zip(self.outputs, results, strict=True)
        }


def read_graph(config: OnnxConfig) -> tuple[OnnxGraph | TorchScript, Path]:
    """Read the checkpoint.

    Args:
        config: The settings of the policy.

    Returns:
        The graph, and its file.

    Raises:
        ConfigError: The checkpoint is not a single file of a supported type, is not trusted, or
            cannot be read.
    """
    path = find_checkpoint(config.checkpoint, config.checkpoint_step)
    files = [path] if path.is_file() else sorted(path.rglob("*"))
    graph_files = [file for file in files if file.suffix in (".onnx", *_TORCHSCRIPT)]
    if len(graph_files) != 1:
        names = [file.name for file in graph_files or files]
        raise ConfigError(
            f"checkpoint {path}: expected one file with the suffix .onnx or "
            f"{', '.join(_TORCHSCRIPT)}, got {names[:10]}; name the file"
        )
    [file] = graph_files

    # The digest of the checkpoint must also cover the files that belong to a single graph file: the
    # weights of a large graph and the tokenizer.
    if path == file:
        for pattern in (f"{file.name}[._]*", TOKENIZER):
            for related in file.parent.glob(pattern):
                find_checkpoint(str(related))

    if file.suffix == ".onnx":
        return OnnxGraph(file, config), file
    if not config.trust_checkpoint:
        raise ConfigError(
            f"checkpoint {file}: a TorchScript archive is a program, which can also read and write "
            "files; set trust_checkpoint: true if you trust its author, or export it as ONNX"
        )
    return TorchScript(file, config), file


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:300]


def _shape(name: str, lengths: Sequence[int] | None, config: OnnxConfig) -> tuple[int, ...]:
    """Return the shape of an input.

    Args:
        name: The name of the input.
        lengths: The lengths in the file, where -1 is an open length; None if the file specifies
            none.
        config: The settings, whose shape has priority over the file's shape.

    Raises:
        ConfigError: Neither the settings nor the file specify a shape, or more than one length is
            -1.
    """
    configured = config.inputs[name].shape if name in config.inputs else None
    shape = lengths if configured is None else configured
    if shape is None or shape.count(-1) > 1:
        raise ConfigError(
            f"inputs: {name}: shape: expected all lengths that the policy was trained with, and "
            f"-1 for the batch, such as [-1, 48], got {configured}, and {lengths or 'none'} in "
            "the file; set them"
        )
    return tuple(shape)


# The part of the state that contains the model's last action, before offset and scale.
PREVIOUS = "previous_output"
# The largest accepted difference between outputs computed alone and in a batch, relative to the
# largest output. It exceeds the effect of another order of summation.
_TOLERANCE = 1e-3


class Network:
    """A graph with the meaning of its inputs and outputs.

    All sessions share it, and no session changes it.
    """

    def __init__(self, graph: OnnxGraph | TorchScript, path: Path, config: OnnxConfig) -> None:
        """Map the inputs and outputs, and test the graph with random rows.

        Args:
            graph: The graph.
            path: The file of the graph.
            config: The settings of the policy.

        Raises:
            ConfigError: The graph does not fit the settings, or cannot be run.
        """
        self.graph = graph
        self.config = config
        self.cameras = config.cameras or {}
        self.options = {name: config.inputs.get(name, Input()) for name in graph.inputs}
        self.vectors: dict[str, list[str]] = {}  # name of each vector input -> its parts
        for name, option in self.options.items():
            if option.state is not None:
                self.vectors[name] = option.state
        self._require_mapped()
        self._require_used()

        self.constants: dict[str, np.ndarray] = {}
        for name, option in self.options.items():
            if option.constant is not None:
                self.constants[name] = self._constant(name)
        self.inputs = {
            name: tensor for name, tensor in graph.inputs.items() if name not in self.constants
        }
        self.tokenizer = self._tokenizer(path)

        self.batched = False
        example = self._try_rows()
        for name, next_value in config.recurrent.items():
            input_shape, output_shape = graph.inputs[name].row_shape, example[next_value].shape
            if output_shape != input_shape:
                raise ConfigError(
                    f"recurrent: {{{name}: {next_value}}}: expected an output of the input's "
                    f"shape, {input_shape}, got {output_shape}; name the output that is the "
                    "input's next value"
                )
        # The value of PREVIOUS before the first action, (H * D,).
        self.zero_output = np.zeros(example[self.action].size, np.float32)
        self._require_fitting(example)
        self.contract = self._contract(*self.chunk(example).shape)

    @cached_property
    def has_memory(self) -> bool:
        """Whether a result depends on earlier results of the session, other than through
        `history`.
        """
        counts_steps = any(option.step is not None for option in self.options.values())
        reads_previous = any(PREVIOUS in parts for parts in self.vectors.values())
        return counts_steps or reads_previous or bool(self.config.recurrent)

    @cached_property
    def action(self) -> str:
        """The name of the output that contains the action."""
        if self.config.action.output:
            return self.config.action.output
        other_outputs = {*self.config.recurrent.values(), *self.config.info}
        return next(name for name in self.graph.outputs if name not in other_outputs)

    def chunk(self, outputs: Arrays) -> np.ndarray:
        """Return the action in the outputs for one observation as a new array, (H, D) float32,
        before it is unnormalized.
        """
        output = outputs[self.action]
        dim = output.shape[-1] if output.ndim else 1
        chunk = output.reshape(-1, dim).astype(np.float32)
        clip = self.config.action.clip
        return chunk if clip is None else chunk.clip(*clip)

    def observed_length(self, name: str) -> int:
        """Return how many numbers of a vector come from one observation, i.e. all except the
        previous output.
        """
        length = self.graph.inputs[name].size // self.options[name].history
        if PREVIOUS in self.vectors[name]:
            length -= len(self.zero_output)
        return length

    def image_size(self, name: str) -> tuple[int, int]:
        """Return the height and the width of an image."""
        shape = self.graph.inputs[name].row_shape
        height, width = shape[-3:-1] if shape[-1] == 3 else shape[-2:]
        return height, width

    def encode_instruction(self, instruction: str) -> dict[str, np.ndarray]:
        """Return the inputs that contain the instruction, with a batch of one.

        Raises:
            InvalidObservation: The instruction has more tokens than an input.
        """
        encoded: dict[str, np.ndarray] = {}
        for name, option in self.options.items():
            tensor = self.graph.inputs[name]
            if option.instruction is None:
                continue
            if option.instruction == "text":
                encoded[name] = np.full(tensor.row_shape, instruction, object)
                continue

            ids = self.tokenizer.encode(instruction).ids
            if len(ids) > tensor.size:
                raise InvalidObservation(
                    f"instruction: expected at most {tensor.size} tokens, got {len(ids)}; shorten "
                    "it"
                )
            is_mask = option.instruction == "mask"
            values = np.full(tensor.size, 0 if is_mask else self.pad_id, tensor.dtype)
            values[: len(ids)] = 1 if is_mask else ids
            encoded[name] = values
        return encoded

    def run(self, rows: Sequence[Arrays]) -> list[dict[str, np.ndarray]]:
        """Return the used outputs of each row.

        If the file has an open batch dimension, all rows are computed in one pass.

        Args:
            rows: The inputs of each row without the constants, with a batch of one.
        """
        if len(rows) > 1 and self.batched:
            return self._run_batch(rows)
        return [self._run_row(row) for row in rows]

    def _run_row(self, row: Arrays) -> dict[str, np.ndarray]:
        outputs = self.graph.run({**row, **self.constants})
        return {name: outputs[name] for name in self._output_axes}

    def _run_batch(self, rows: Sequence[Arrays]) -> list[dict[str, np.ndarray]]:
        feeds: dict[str, np.ndarray] = {}
        for name, tensor in self.inputs.items():
            feeds[name] = np.concatenate([row[name] for row in rows], tensor.batch_axis)
        for name, value in self.constants.items():
            axis = self.graph.inputs[name].batch_axis
            feeds[name] = value if axis is None else np.repeat(value, len(rows), axis)
        outputs = self.graph.run(feeds)

        row_outputs: list[dict[str, np.ndarray]] = [{} for _ in rows]
        for name, axis in self._output_axes.items():
            blocks = np.split(outputs[name], len(rows), axis)
            for of_row, block in zip(row_outputs, blocks, strict=True):
                of_row[name] = block
        return row_outputs

    def _try_rows(self) -> dict[str, np.ndarray]:
        """Run random rows, decide whether rows may share a pass, and return the outputs of one row.

        Raises:
            ConfigError: The graph fails, or returns different outputs for the same inputs.
        """
        # The used outputs, with the index of their batch dimension.
        self._output_axes = dict.fromkeys((self.action, *self.config.info), 0)
        for name, next_value in self.config.recurrent.items():
            self._output_axes[next_value] = self.graph.inputs[name].batch_axis or 0

        rng = np.random.default_rng(0)
        rows = []
        for _ in range(2):
            rows.append({name: tensor.random(rng) for name, tensor in self.inputs.items()})
        try:
            *alone, again = self.run([*rows, rows[0]])
        except ConfigError:
            raise
        except Exception as error:  # the runtimes raise errors of many classes
            shapes = ", ".join(
                f"{name} {tensor.row_shape} {tensor.dtype}" for name, tensor in self.inputs.items()
            )
            raise ConfigError(f"the file fails on {shapes}: {_first_line(error)}") from error

        if not _close(alone[0], again):
            raise ConfigError(
                "the file computes another output from the same inputs: it draws noise, or keeps a "
                "state, in which sessions would mix; export the noise or the state as an input "
                "(`noise: true`, or `recurrent`)"
            )
        self.batched = self._can_batch(rows, alone)
        return alone[0]

    def _can_batch(self, rows: Sequence[Arrays], alone: Sequence[Mapping[str, np.ndarray]]) -> bool:
        """Return whether rows have the same outputs in one pass as alone.

        If they differ, log the reason.
        """
        if any(tensor.batch_axis is None for tensor in self.inputs.values()):
            return False

        try:
            if all(map(_close, alone, self._run_batch(rows))):
                return True
            # This happens if the open dimension is the length of a sequence.
            reason = "rows of a batch change each other's outputs"
        except Exception as error:  # noqa: BLE001 - the open dimension may not be the batch
            reason = _first_line(error)
        log.warning(
            "rows are computed one by one, as the file's open dimension is not the batch: %s",
            reason,
        )
        return False

    def _require_mapped(self) -> None:
        """Assign the parts in `state` to the only input without another source.

        Raises:
            ConfigError: An input has no source or several, the action is not determined, or a name
                is unknown.
        """
        config, inputs, outputs = self.config, self.graph.inputs, self.graph.outputs
        with_source = []
        for name, option in config.inputs.items():
            if option.model_fields_set & {*SOURCES}:
                with_source.append(name)
        named_inputs = [*self.cameras, *config.recurrent, *with_source]
        without_source = [name for name in inputs if name not in named_inputs]
        unused_state: list[str] = []  # the parts in `state`, if no input remains for them
        if config.state is not None:
            if not without_source:
                unused_state = config.state
            elif len(without_source) == 1:
                self.vectors[without_source.pop()] = config.state

        other_outputs = {*config.recurrent.values(), *config.info}
        named_outputs = set(other_outputs)
        if config.action.output:
            named_outputs.add(config.action.output)
        unknown = {*self.cameras, *config.inputs, *config.recurrent} - inputs.keys()
        unknown |= named_outputs - {*outputs}

        action_candidates: list[str] = []  # candidates, if the action is not determined
        if not config.action.output:
            action_candidates = [name for name in outputs if name not in other_outputs]
            if len(action_candidates) == 1:
                action_candidates = []
            elif not action_candidates:
                action_candidates = ["none of the outputs"]

        problems = {
            "unknown": sorted(unknown),
            "named twice": sorted({name for name in named_inputs if named_inputs.count(name) > 1}),
            "inputs without a source": without_source,
            "parts in `state` without an input": unused_state,
            "one of them the action": action_candidates,
        }
        summary = "; ".join(f"{problem}: {names}" for problem, names in problems.items() if names)
        if summary:
            shapes = ", ".join(f"{name} {tensor.shape}" for name, tensor in inputs.items())
            raise ConfigError(
                f"the file has inputs {shapes} and outputs {outputs}, which the settings do not "
                f"fit, {summary}; name each input in `cameras`, `recurrent` or `inputs`, but for "
                "one, which has the parts in `state`, and the output in `action`"
            )

    def _require_used(self) -> None:
        """Raise `ConfigError` for options that an input does not use, and for statistics of parts
        that the input does not have.
        """
        unused = {"action": self.config.action.parts}
        for name, option in self.config.inputs.items():
            unused_options = option.model_fields_set - self._usable_options(name)
            unknown_parts = option.parts - {*self.vectors.get(name, ())}
            unused[f"inputs: {name}"] = unused_options | unknown_parts
        for setting, names in unused.items():
            if names:
                raise ConfigError(
                    f"{setting}: expected names that are used, got {sorted(names)}; leave them "
                    "out, or correct the names"
                )

    def _usable_options(self, name: str) -> set[str]:
        """Return the fields of `Input` that have an effect for an input."""
        usable = {"shape", *SOURCES}
        if name in self.cameras:
            usable |= {"history", "resize"}
            if self.graph.inputs[name].dtype == np.uint8:
                return usable  # The model receives the pixels unchanged.
            usable |= {"range", *Scaling.model_fields}
        elif name in self.vectors:
            usable |= {"history", *Scaling.model_fields}
        return usable

    def _constant(self, name: str) -> np.ndarray:
        tensor, value = self.graph.inputs[name], self.options[name].constant
        try:
            return np.broadcast_to(np.asarray(value, tensor.dtype), tensor.row_shape).copy()
        except ValueError as error:
            raise ConfigError(
                f"inputs: {name}: constant: expected numbers of shape {tensor.row_shape}, got "
                f"{value}"
            ) from error

    def _require_fitting(self, example: Arrays) -> None:
        """Raise `ConfigError` unless the inputs of cameras have the shape of images, and lists of
        statistics are as long as the vectors that they scale.
        """
        # The setting, its conversion function, and example numbers of the converted shape.
        conversions: list[tuple[str, Any, Any]] = [
            ("action", self.config.action.unnormalized, self.chunk(example))
        ]
        for name in self.cameras:
            option, tensor = self.options[name], self.graph.inputs[name]
            height, width = self.image_size(name)
            if len(tensor.shape) < 4 or tensor.size != option.history * height * width * 3:
                raise ConfigError(
                    f"cameras: {name}: expected an input (-1, 3, H, W) or (-1, H, W, 3), with "
                    f"`history` images before them, got {tensor.shape}; check whether it is an "
                    "image"
                )
            conversions.append((f"inputs: {name}", option.normalized, np.zeros((1, 3))))

        for name, parts in self.vectors.items():
            if self.observed_length(name) < 0 or parts.count(PREVIOUS) > 1:
                raise ConfigError(
                    f"inputs: {name}: {PREVIOUS} has {len(self.zero_output)} numbers, which do not "
                    "fit into this input"
                )
            values = self.zero_output if PREVIOUS in parts else np.zeros(self.observed_length(name))
            conversions.append((f"inputs: {name}", self.options[name].normalized, values))

        for setting, convert, values in conversions:
            try:
                fits = convert(values).shape == values.shape
            except ValueError:
                fits = False
            if not fits:
                raise ConfigError(
                    f"{setting}: expected statistics of {values.shape[-1]} numbers, or one for "
                    f"all, got another length; with {PREVIOUS}, give statistics by part"
                )

    def _tokenizer(self, path: Path) -> Any:
        """Read the tokenizer next to the graph's file. Return None if no input needs it."""
        if not {"tokens", "mask"} & {option.instruction for option in self.options.values()}:
            return None

        file = path.with_name(TOKENIZER)
        if not file.is_file():
            raise ConfigError(
                f"{file}: expected the instruction's tokenizer, by `tokenizers`, got none; copy "
                "it there"
            )
        tokenizer = require("tokenizers", extra="onnx").Tokenizer.from_file(str(file))
        self.pad_id = (tokenizer.padding or {}).get("pad_id", 0)
        tokenizer.no_padding()
        tokenizer.no_truncation()
        return tokenizer

    def _contract(self, horizon: int, dim: int) -> Contract:
        """Return the contract that follows from the settings and the shapes in the file."""
        config = self.config
        try:
            configured = Contract.from_json(config.contract)
        except MalformedMessage as error:
            raise ConfigError(f"contract: {error}") from error

        cameras: dict[str, CameraSpec] = {}
        for name, camera in self.cameras.items():
            resizes = self.options[name].resize
            cameras[camera] = CameraSpec() if resizes else CameraSpec(*self.image_size(name))
        state = {}
        for name, parts in self.vectors.items():
            observed_parts = [part for part in parts if part != PREVIOUS]
            state.update(state_specs(observed_parts, self.observed_length(name)))

        histories = [option.history for option in self.options.values()]
        if self.has_memory:
            histories.append(config.burn_in)
        return replace(
            configured,
            cameras=cameras,
            state=state | dict(configured.state or {}),
            gripper=any(map(needs_gripper, self.vectors.values())),
            instruction=any(option.instruction for option in self.options.values()),
            action=replace(configured.action, dim=dim),
            chunk=min(config.execute or horizon, horizon) if config.actions == "chunk" else 1,
            history=max(histories, default=0),
        )


def _close(outputs: Arrays, expected: Arrays) -> bool:
    """Return whether all outputs equal the expected ones up to `_TOLERANCE`."""
    for name, expected_values in expected.items():
        values = outputs[name]
        largest = np.abs(expected_values[np.isfinite(expected_values)]).max(initial=1)
        if values.shape != expected_values.shape or not np.allclose(
            values, expected_values, rtol=0, atol=_TOLERANCE * largest, equal_nan=True
        ):
            return False
    return True


_STEP, _RECURRENT = "step", "recurrent"  # keys of a session's memory, in addition to PREVIOUS


@dataclass(slots=True)
class Frame:
    """The inputs of one observation."""

    values: dict[str, np.ndarray]
    # The index in a vector at which PREVIOUS begins, until the next pass fills it in.
    gaps: dict[str, int] = field(default_factory=dict)


class Onnx(ModelPolicy):
    """An exported policy. Its memory is a step counter, the previous output, and the recurrent
    inputs.
    """

    Config: ClassVar[type] = OnnxConfig
    config: OnnxConfig

    @property
    def history(self) -> int:
        if self.model is None:
            return 1
        return max((option.history for option in self.model.options.values()), default=1)

    @property
    def contract(self) -> Contract:
        return Contract() if self.model is None else self.model.contract

    @property
    def batched(self) -> bool:
        return bool(self.loaded().batched)

    def load(self) -> Network:
        """Read the file; raises `ConfigError` if it cannot be read or does not fit the
        settings.
        """
        graph, path = read_graph(self.config)
        return Network(graph, path, self.config)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, and encode its instruction."""
        info = super().reset(obs, instruction, **kwargs)
        self._current_episode().prompt = self.loaded().encode_instruction(instruction or "")
        return info

    def observe(self, obs: Obs) -> None:
        """Add an observation without requesting an action.

        The model also computes its next memory from this observation.
        """
        super().observe(obs)
        if self.model.has_memory:
            episode = self._current_episode()
            frames = tuple(episode.frames)
            row = Row(frames, episode.instruction, episode.rng, memory=episode.memory)
            # As for an action, so that the memory has the bits of a pass of the usual size.
            self._forward([row])

    def perceive(self, obs: Obs) -> Frame:
        """Return the inputs that come from an observation and from the instruction."""
        network: Network = self.model
        frame = Frame(dict(self._current_episode().prompt))
        for name, image in camera_images(obs, network.cameras).items():
            frame.values[name] = self._pixels(name, image)
        for name in network.vectors:
            self._add_vector(frame, name, obs)
        return frame

    def _add_vector(self, frame: Frame, name: str, obs: Obs) -> None:
        """Add a vector of an observation to a frame, with a gap for PREVIOUS."""
        network: Network = self.model
        option, parts = network.options[name], network.vectors[name]
        length = network.observed_length(name)
        if not option.parts and PREVIOUS not in parts:
            frame.values[name] = option.normalized(state_vector(obs, parts, length))
            return

        # This call raises an error if the observation does not fit.
        state_vector(obs, [part for part in parts if part != PREVIOUS], length)
        blocks: list[np.ndarray] = []
        for part in parts:
            if part == PREVIOUS:
                frame.gaps[name] = sum(len(block) for block in blocks)
                blocks.append(network.zero_output)
            else:
                blocks.append(state_vector(obs, [part]))

        try:
            blocks = [
                option.normalized(block, part) for block, part in zip(blocks, parts, strict=True)
            ]
        except ValueError as error:
            raise InvalidObservation(
                f"state: the statistics of {name!r} do not fit its parts: {error}"
            ) from error
        frame.values[name] = np.concatenate(blocks)

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks of all rows, and update the memory of each."""
        network: Network = self.model
        config = self.config
        outputs_by_row = network.run([self._feed(row) for row in rows])

        predictions = []
        for row, outputs in zip(rows, outputs_by_row, strict=True):
            chunk = network.chunk(outputs)
            if network.has_memory:
                row.memory[_STEP] = row.memory.get(_STEP, 0) + 1
                row.memory[PREVIOUS] = chunk.ravel()
                row.memory[_RECURRENT] = {
                    name: outputs[next_value].copy()
                    for name, next_value in config.recurrent.items()
                }
            info = {name: outputs[name] for name in config.info}
            predictions.append(Prediction(config.action.unnormalized(chunk), info=info))
        return predictions

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        rng = np.random.default_rng(seed)
        values: dict[str, np.ndarray] = {}
        for name, tensor in self.model.graph.inputs.items():
            length = tensor.size // self.model.options[name].history
            values[name] = tensor.random(rng).ravel()[:length]
        return Row((Frame(values),), instruction, rng)

    def _feed(self, row: Row) -> dict[str, np.ndarray]:
        """Return the inputs of a row, with a batch of one."""
        self._fill_gaps(row)
        feed: dict[str, np.ndarray] = {}
        for name, tensor in self.model.inputs.items():
            option = self.model.options[name]
            if name in self.config.recurrent:
                value = row.memory.get(_RECURRENT, {}).get(name, tensor.zeros())
            elif option.step is not None:
                value = np.full(tensor.row_shape, option.step + row.memory.get(_STEP, 0))
            elif option.noise:
                value = row.noise(*tensor.row_shape)
            else:
                values = [frame.values[name] for frame in row.history(option.history)]
                value = np.stack(values).reshape(tensor.row_shape)
            feed[name] = value.astype(tensor.dtype, copy=False)
        return feed

    def _fill_gaps(self, row: Row) -> None:
        """Write the previous output into the frames that were observed since it was computed."""
        network: Network = self.model
        output = row.memory.get(PREVIOUS, network.zero_output)
        for frame in row.frames:
            for name, start in frame.gaps.items():
                previous = network.options[name].normalized(output, PREVIOUS)
                frame.values[name][start : start + len(previous)] = previous
            frame.gaps = {}

    def _pixels(self, name: str, image: np.ndarray) -> np.ndarray:
        """Convert an image, (H, W, 3) uint8, to the model's input, without the batch dimension."""
        network: Network = self.model
        option, tensor = network.options[name], network.graph.inputs[name]
        height, width = network.image_size(name)
        if option.resize:
            image = resize_with_pad(image, height, width)
        if image.shape[:2] != (height, width):
            raise InvalidObservation(
                f"camera {network.cameras[name]!r}: expected {height}x{width}, got "
                f"{image.shape[0]}x{image.shape[1]}; send that size, or set `resize: true` for "
                f"the input {name!r}"
            )

        if tensor.dtype != np.uint8:
            low, high = map(np.float32, option.range)
            scaled = image.astype(np.float32) * (high - low) / np.float32(255) + low
            image = option.normalized(scaled)
        channels_last = tensor.row_shape[-1] == 3
        return image.copy() if channels_last else image.transpose(2, 0, 1).copy()
