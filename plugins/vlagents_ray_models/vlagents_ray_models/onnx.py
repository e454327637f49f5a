"""Exported policies of any kind, ONNX files and TorchScript archives.

A deployment file states the source of each input, and the meaning of the outputs. Each session
keeps its recurrent state, and all share a batch.
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
    """The conversion of the robot's numbers to the model's, (x - mean) / std, and of the
    action's numbers back.
    """

    mean: Numbers | dict[str, Numbers] = Field(
        default=0.0,
        description="one for all, a list, or either by part of the state; of an action, its offset",
    )
    std: Numbers | dict[str, Numbers] = Field(
        default=1.0, description="as `mean`; of an action, its scale"
    )
    min: Numbers | dict[str, Numbers] | None = Field(
        default=None, description="with `max`, becomes -1 in the model"
    )
    max: Numbers | dict[str, Numbers] | None = Field(
        default=None, description="with `min`, becomes 1 in the model"
    )
    clip: tuple[float, float] | None = Field(
        default=None, description="limits of the model's numbers"
    )
    _known: dict[str, tuple[Any, Any]] = PrivateAttr(default_factory=dict)  # mean and std by part

    @model_validator(mode="after")
    def _one_pair(self) -> Self:
        if (self.min is None) != (self.max is None) or (
            self.min is not None and {"mean", "std"} & self.model_fields_set
        ):
            raise ValueError("want min and max, or mean and std, or neither pair")
        return self

    @property
    def parts(self) -> set[str]:
        """The parts of the state that have their own statistics."""
        named = (one for one in (self.mean, self.std, self.min, self.max) if isinstance(one, dict))
        return {part for one in named for part in one}

    def normalized(self, values: np.ndarray, part: str = "") -> np.ndarray:
        """Return the robot's numbers, float32, as the model's; `part` is the name of the part of
        the state.
        """
        if self.model_fields_set & {"mean", "std", "min"}:
            mean, std = self._statistics(part)
            values = (values - mean) / std
        return values if self.clip is None else values.clip(*self.clip)

    def unnormalized(self, values: np.ndarray) -> np.ndarray:
        """Return the model's numbers, float32, as the robot's."""
        mean, std = self._statistics()
        restored: np.ndarray = values * std + mean
        return restored

    def _statistics(self, part: str = "") -> tuple[Any, Any]:
        def named(value: Any, usual: float) -> Any:
            return np.asarray(
                value.get(part, usual) if isinstance(value, dict) else value, np.float32
            )

        if part not in self._known:
            if self.min is None:
                self._known[part] = named(self.mean, 0.0), named(self.std, 1.0)
            else:
                low, high = named(self.min, -1.0), named(self.max, 1.0)
                self._known[part] = (high + low) / 2, (high - low) / 2
        return self._known[part]


class Input(Scaling):
    """The source of an input that is neither a camera nor the state, and the conversion of any
    input.
    """

    state: list[str] | None = Field(
        default=None, description="as the policy's `state`, for one of several vectors"
    )
    constant: float | list[Any] | None = Field(
        default=None, description="the same numbers in each act"
    )
    step: float | None = Field(
        default=None, description="a counter of the session's passes, which begins with this"
    )
    noise: Literal[True] | None = Field(
        default=None, description="standard normal numbers, by the session's seed"
    )
    instruction: Literal["text", "tokens", "mask"] | None = Field(
        default=None,
        description="a string, or the ids by tokenizer.json beside the file, or the mask of the "
        "ids",
    )
    history: int = Field(
        default=1, ge=1, description="how many of the last observations it holds, oldest first"
    )
    shape: list[int] | None = Field(
        default=None,
        description="for a file that leaves lengths open, as all TorchScript does; -1 is the batch",
    )
    range: tuple[float, float] = Field(
        default=(0.0, 1.0), description="of an image that is not uint8"
    )
    resize: bool = Field(
        default=False, description="take images of any size, and pad them with black"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        named = [name for name in SOURCES if getattr(self, name) is not None]
        if len(named) > 1:
            raise ValueError(f"got {named}, want one source of an input")
        return self


class Action(Scaling):
    """The output that is the action: offset (`mean`) plus scale (`std`) times the model's
    numbers.
    """

    output: str | None = Field(
        default=None, description="its name; unset: the only one that nothing else names"
    )


class OnnxConfig(ModelConfig):
    """Settings of an exported policy, in addition to those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="an .onnx file or a TorchScript archive (.pt, .jit), or a folder or "
        "org/name@COMMIT of the hub "
        "with one; `{step}` stands for checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False,
        description="a TorchScript archive is a program: set true if you trust its author",
    )
    dtype: Literal["auto"] = Field(default="auto", description="the file's")
    compile: Literal[False, "auto"] = Field(
        default="auto", description="nothing to compile: the runtime optimises it"
    )
    threads: int = Field(default=1, ge=0, description="of ONNX Runtime on a CPU; 0: its own choice")

    cameras: dict[str, str] | None = Field(
        default=None, description="each input that is an image -> your camera"
    )
    state: list[str] | None = Field(
        default=None,
        description="parts of the one input that no other setting names, in their order; "
        "'previous_output' is the last "
        "action before offset and scale, zeros at first",
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
    info: list[str] = Field(default=[], description="outputs that an act returns in its info")
    contract: dict[str, Any] = Field(
        default={},
        description="facts that the file lacks: {control_hz: 50, action: {space: joint, delta: "
        "false}}",
    )
    burn_in: int = Field(
        default=32,
        ge=1,
        le=256,
        description="last observations from which a memory is computed again, if the session's "
        "replica is lost",
    )


TOKENIZER = "tokenizer.json"
_TORCHSCRIPT = (".pt", ".pth", ".jit")
# Those that numpy names otherwise.
_TYPES = {"float": "float32", "double": "float64", "string": "object"}

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
        # errors: it warns of each unused weight that an exporter left.
        options.log_severity_level = 3
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=[(provider, settings)]
            )
        except Exception as error:
            raise ConfigError(
                f"checkpoint {path}: ONNX Runtime cannot read it: {_first_line(error)}"
            ) from error
        # It only warns, and would compute on the CPU.
        if provider not in self._session.get_providers():
            raise ConfigError(
                f"device {config.device!r}: {provider} did not start, as the log says; install the "
                "CUDA and cuDNN that this onnxruntime-gpu needs, or set device: cpu with "
                "resources: {num_gpus: 0}"
            )
        self.outputs: list[str] = [one.name for one in self._session.get_outputs()]
        self.inputs: dict[str, Tensor] = {}
        for one in self._session.get_inputs():
            kind = one.type.removeprefix("tensor(").removesuffix(")")
            stated = [length if isinstance(length, int) else -1 for length in one.shape]
            self.inputs[one.name] = Tensor(
                _shape(one.name, stated, config), np.dtype(_TYPES.get(kind, kind))
            )

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
            raise ConfigError(
                f"checkpoint {path}: torch.jit.load cannot read it: {_first_line(error)}"
            ) from error
        self.inputs = {
            name: Tensor(_shape(name, None, config), np.dtype(np.float32)) for name in names
        }

    def run(self, feeds: Arrays) -> dict[str, np.ndarray]:
        torch = require("torch")
        with torch.inference_mode():
            found = self._module(
                *(torch.from_numpy(feeds[name]).to(self._device) for name in self.inputs)
            )
        found = found if isinstance(found, tuple | list) else (found,)
        if len(found) != len(self.outputs):
            raise ConfigError(
                f"outputs: got {self.outputs}, want names for the {len(found)} results of `forward`"
            )
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
            f"checkpoint {path}: got {[one.name for one in found or files][:10]}, want one file "
            f"with the suffix .onnx or {', '.join(_TORCHSCRIPT)}; name that file"
        )
    [file] = found
    # The parts beside it count for its digest, too: weights of a large graph, the tokenizer.
    if path == file:
        for pattern in (f"{file.name}[._]*", TOKENIZER):
            for part in file.parent.glob(pattern):
                find_checkpoint(str(part))
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


def _shape(name: str, stated: Sequence[int] | None, config: OnnxConfig) -> tuple[int, ...]:
    """Return the shape of an input, of which the file states what is not -1."""
    given = config.inputs[name].shape if name in config.inputs else None
    shape = stated if given is None else given
    if shape is None or shape.count(-1) > 1:
        raise ConfigError(
            f"inputs: {name}: shape: got {given}, the file states {stated or 'none'}, want all "
            "lengths that the policy was trained with, and -1 for the batch, such as [-1, 48]"
        )
    return tuple(shape)


# The part of the state that is the model's last action, in the model's numbers.
PREVIOUS = "previous_output"
# Of outputs alone and in a batch, relative to the largest: more than another order of sums changes.
_TOLERANCE = 1e-3


class Network:
    """A graph whose inputs and outputs have a meaning; all sessions share it, and change nothing
    in it.
    """

    def __init__(self, graph: OnnxGraph | TorchScript, path: Path, config: OnnxConfig) -> None:
        """Map the inputs and outputs, and try the graph on random rows; raises `ConfigError` if
        they do not fit.
        """
        self.graph, self.config, self.cameras = graph, config, config.cameras or {}
        self.options = {name: config.inputs.get(name, Input()) for name in graph.inputs}
        self.vectors = {
            name: one.state for name, one in self.options.items() if one.state is not None
        }
        self._require_mapped()
        self._require_used()
        self.constants = {
            name: self._constant(name)
            for name, one in self.options.items()
            if one.constant is not None
        }
        self.inputs = {
            name: one for name, one in graph.inputs.items() if name not in self.constants
        }
        self.tokenizer = self._tokenizer(path)
        self.batched = False
        example = self._try_rows()
        for name, later in config.recurrent.items():
            if example[later].shape != graph.inputs[name].row:
                raise ConfigError(
                    f"recurrent: {{{name}: {later}}}: got an output {example[later].shape} for an "
                    f"input {graph.inputs[name].row}, want equal shapes; name the output that is "
                    "the input's next value"
                )
        self.previous = np.zeros(example[self.action].size, np.float32)
        self._require_fitting(example)
        self.contract = self._contract(*self.chunk(example).shape)

    @cached_property
    def remembers(self) -> bool:
        """Whether an act depends on earlier ones of its session, other than by `history`."""
        steps = any(one.step is not None for one in self.options.values())
        return (
            steps
            or bool(self.config.recurrent)
            or any(PREVIOUS in parts for parts in self.vectors.values())
        )

    @cached_property
    def action(self) -> str:
        """The output that is the action."""
        others = {*self.config.recurrent.values(), *self.config.info}
        return self.config.action.output or next(
            name for name in self.graph.outputs if name not in others
        )

    def chunk(self, outputs: Arrays) -> np.ndarray:
        """Return the action in a row's outputs as a new array (H, D) float32, in the model's
        numbers.
        """
        output, clip = outputs[self.action], self.config.action.clip
        rows = output.reshape(-1, output.shape[-1] if output.ndim else 1).astype(np.float32)
        return rows if clip is None else rows.clip(*clip)

    def length(self, name: str) -> int:
        """Return how many numbers of a vector come from one observation, without the previous
        output.
        """
        previous = PREVIOUS in self.vectors[name]
        return (
            self.graph.inputs[name].size // self.options[name].history
            - len(self.previous) * previous
        )

    def size(self, name: str) -> tuple[int, int]:
        """Return height and width of an image."""
        shape = self.graph.inputs[name].row
        height, width = shape[-3:-1] if shape[-1] == 3 else shape[-2:]
        return height, width

    def texts(self, instruction: str) -> dict[str, np.ndarray]:
        """Return the inputs that an instruction becomes."""
        found = {}
        for name, one in self.options.items():
            tensor = self.graph.inputs[name]
            if one.instruction == "text":
                found[name] = np.full(tensor.row, instruction, object)
            elif one.instruction is not None:
                ids = self.tokenizer.encode(instruction).ids
                if len(ids) > tensor.size:
                    raise InvalidObservation(
                        f"instruction: got {len(ids)} tokens, want at most {tensor.size}; shorten "
                        "it"
                    )
                mask = one.instruction == "mask"
                found[name] = np.full(tensor.size, 0 if mask else self.pad, tensor.dtype)
                found[name][: len(ids)] = 1 if mask else ids
        return found

    def run(self, rows: Sequence[Arrays]) -> list[dict[str, np.ndarray]]:
        """Return the used outputs of each row: of all in one pass, if the file has an open batch.

        Args:
            rows: The inputs of each row but the constants, with a batch of one.
        """
        if len(rows) == 1 or not self.batched:
            found = [self.graph.run({**row, **self.constants}) for row in rows]
            return [{name: one[name] for name in self._used} for one in found]
        feeds = {
            name: np.concatenate([row[name] for row in rows], one.axis)
            for name, one in self.inputs.items()
        }
        for name, value in self.constants.items():
            axis = self.graph.inputs[name].axis
            feeds[name] = value if axis is None else np.repeat(value, len(rows), axis)
        together = self.graph.run(feeds)
        split = {
            name: np.split(together[name], len(rows), axis) for name, axis in self._used.items()
        }
        return [{name: parts[i] for name, parts in split.items()} for i in range(len(rows))]

    def _try_rows(self) -> dict[str, np.ndarray]:
        """Find out whether rows may share a pass, and return the outputs of one."""
        recurrent = {
            later: self.graph.inputs[name].axis or 0
            for name, later in self.config.recurrent.items()
        }
        # With the batch's dimension.
        self._used = dict.fromkeys((self.action, *self.config.info), 0) | recurrent
        rng = np.random.default_rng(0)
        rows = [{name: one.random(rng) for name, one in self.inputs.items()} for _ in range(2)]
        try:
            *alone, again = self.run([*rows, rows[0]])
        except ConfigError:
            raise
        except Exception as error:  # of the runtimes' many classes
            shapes = ", ".join(f"{name} {one.row} {one.dtype}" for name, one in self.inputs.items())
            raise ConfigError(f"the file fails on {shapes}: {_first_line(error)}") from error
        if not _close(alone[0], again):
            raise ConfigError(
                "the file computes another output from the same inputs: it draws noise, or keeps a "
                "state, in which sessions would mix; export that as an input (`noise: true`, or "
                "`recurrent`)"
            )
        self.batched = all(one.axis is not None for one in self.inputs.values())
        try:
            self.batched = self.batched and all(map(_close, alone, self.run(rows)))
            # As those of a sequence, if its length is open and not the batch.
            why = "rows change each other in it"
        except Exception as error:  # noqa: BLE001 - an open length may be another than the batch's
            self.batched, why = False, _first_line(error)
        if not self.batched and all(one.axis is not None for one in self.inputs.values()):
            log.warning(
                "rows are computed one by one, as the file's open dimension is no batch: %s", why
            )
        return alone[0]

    def _require_mapped(self) -> None:
        """Give the one input that nothing names the parts in `state`; raises `ConfigError`
        unless all are mapped.
        """
        config, inputs, outputs = self.config, self.graph.inputs, self.graph.outputs
        sourced = [name for name, one in config.inputs.items() if one.model_fields_set & {*SOURCES}]
        named = [*self.cameras, *config.recurrent, *sourced]
        left = [name for name in inputs if name not in named] or ["state"] * (
            config.state is not None
        )
        if config.state is not None and len(left) == 1 and left[0] in inputs:
            self.vectors[left.pop()] = config.state
        unknown = {*self.cameras, *config.inputs, *config.recurrent} - inputs.keys()
        of_others = {*config.recurrent.values(), *config.info}
        unknown |= {*of_others, *filter(None, [config.action.output])} - {*outputs}
        free = [name for name in outputs if name not in of_others]
        problems = {
            "unknown": sorted(unknown),
            "named twice": sorted({name for name in named if named.count(name) > 1}),
            "inputs without a source": left,
            "one of them the action": []
            if config.action.output or len(free) == 1
            else free or ["none of the outputs"],
        }
        if said := "; ".join(f"{what}: {names}" for what, names in problems.items() if names):
            raise ConfigError(
                "the file has inputs "
                f"{', '.join(f'{name} {one.shape}' for name, one in inputs.items())} and outputs "
                f"{outputs}, which the settings do not fit, {said}; name each input in `cameras`, "
                "`recurrent` or `inputs`, but for one, which has the parts in `state`, and the "
                "output in `action`"
            )

    def _require_used(self) -> None:
        """Raise `ConfigError` for an option that its input does not use, and a part that it does
        not have.
        """
        unused = {"action": self.config.action.parts}
        for name, one in self.config.inputs.items():
            usable = {"shape", *SOURCES}
            if name in {*self.vectors, *self.cameras}:
                usable |= {"history", *Scaling.model_fields}
            if name in self.cameras:
                raw = self.graph.inputs[name].dtype == np.uint8
                usable = (usable - {*Scaling.model_fields} if raw else usable | {"range"}) | {
                    "resize"
                }
            unused[f"inputs: {name}"] = (one.model_fields_set - usable) | (
                one.parts - {*self.vectors.get(name, ())}
            )
        for where, names in unused.items():
            if names:
                raise ConfigError(
                    f"{where}: has no use of {sorted(names)}; leave it out, or correct the name"
                )

    def _constant(self, name: str) -> np.ndarray:
        tensor, value = self.graph.inputs[name], self.options[name].constant
        try:
            return np.broadcast_to(np.asarray(value, tensor.dtype), tensor.row).copy()
        except ValueError as error:
            raise ConfigError(
                f"inputs: {name}: constant: got {value}, want numbers of {tensor.row}"
            ) from error

    def _require_fitting(self, example: Arrays) -> None:
        """Raise `ConfigError` unless images are images, and lists of statistics as long as their
        numbers.
        """
        scaled: list[tuple[str, Any, Any]] = [
            ("action", self.config.action.unnormalized, self.chunk(example))
        ]
        for name in self.cameras:
            tensor, (height, width) = self.graph.inputs[name], self.size(name)
            if (
                len(tensor.shape) < 4
                or tensor.size != self.options[name].history * height * width * 3
            ):
                raise ConfigError(
                    f"cameras: {name}: got an input {tensor.shape}, want (-1, 3, H, W) or (-1, H, "
                    "W, 3), with `history` images before them; is it an image?"
                )
            scaled.append((f"inputs: {name}", self.options[name].normalized, np.zeros((1, 3))))
        for name, parts in self.vectors.items():
            if self.length(name) < 0 or parts.count(PREVIOUS) > 1:
                raise ConfigError(
                    f"inputs: {name}: {PREVIOUS} has {len(self.previous)} numbers, which do not "
                    "fit in"
                )
            values = self.previous if PREVIOUS in parts else np.zeros(self.length(name))
            scaled.append((f"inputs: {name}", self.options[name].normalized, values))
        for where, convert, values in scaled:
            try:
                fits = convert(values).shape == values.shape
            except ValueError:
                fits = False
            if not fits:
                raise ConfigError(
                    f"{where}: got lists of statistics of another length, want {values.shape[-1]} "
                    f"numbers, or one for all; with {PREVIOUS}, statistics by part"
                )

    def _tokenizer(self, path: Path) -> Any:
        if not {"tokens", "mask"} & {one.instruction for one in self.options.values()}:
            return None
        if not path.with_name(TOKENIZER).is_file():
            raise ConfigError(
                f"{path.with_name(TOKENIZER)}: is missing, want that of the instruction, by "
                "`tokenizers`"
            )
        tokenizer = require("tokenizers", extra="onnx").Tokenizer.from_file(
            str(path.with_name(TOKENIZER))
        )
        self.pad = (tokenizer.padding or {}).get("pad_id", 0)
        tokenizer.no_padding()
        tokenizer.no_truncation()
        return tokenizer

    def _contract(self, horizon: int, dim: int) -> Contract:
        config, state = self.config, {}
        for name, parts in self.vectors.items():
            state.update(
                state_specs([part for part in parts if part != PREVIOUS], self.length(name))
            )
        try:
            stated = Contract.from_json(config.contract)
        except MalformedMessage as error:
            raise ConfigError(f"contract: {error}") from error
        return replace(
            stated,
            cameras={
                ours: CameraSpec() if self.options[name].resize else CameraSpec(*self.size(name))
                for name, ours in self.cameras.items()
            },
            state=state | dict(stated.state or {}),
            gripper=any(map(needs_gripper, self.vectors.values())),
            instruction=any(one.instruction for one in self.options.values()),
            action=replace(stated.action, dim=dim),
            chunk=min(config.execute or horizon, horizon) if config.actions == "chunk" else 1,
            history=max(
                [config.burn_in * self.remembers, *(one.history for one in self.options.values())]
            ),
        )


def _close(found: Arrays, wanted: Arrays) -> bool:
    def close(one: np.ndarray, other: np.ndarray) -> bool:
        largest = np.abs(other[np.isfinite(other)]).max(initial=1)
        return one.shape == other.shape and np.allclose(
            one, other, rtol=0, atol=_TOLERANCE * largest, equal_nan=True
        )

    return all(close(found[name], one) for name, one in wanted.items())


_STEP, _RECURRENT = "step", "recurrent"  # keys in a session's memory, beside PREVIOUS


@dataclass(slots=True)
class Frame:
    """The inputs of one observation."""

    values: dict[str, np.ndarray]
    # Where PREVIOUS belongs in a vector, until an act fills it.
    gaps: dict[str, int] = field(default_factory=dict)


class Onnx(ModelPolicy):
    """An exported policy. Its memory is a step counter, the previous output, and the recurrent
    inputs.
    """

    Config: ClassVar[type] = OnnxConfig
    config: OnnxConfig

    @property
    def history(self) -> int:
        return (
            1
            if self.model is None
            else max((one.history for one in self.model.options.values()), default=1)
        )

    @property
    def contract(self) -> Contract:
        return Contract() if self.model is None else self.model.contract

    def load(self) -> Network:
        return Network(*read_graph(self.config), self.config)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        info = super().reset(obs, instruction, **kwargs)
        self._begun().prompt = self.loaded().texts(instruction or "")
        return info

    def observe(self, obs: Obs) -> None:
        """Add an observation, from which the model also computes its next memory."""
        super().observe(obs)
        if self.model.remembers:
            episode = self._begun()
            self.predict(
                [
                    Row(
                        tuple(episode.frames),
                        episode.instruction,
                        episode.rng,
                        memory=episode.memory,
                    )
                ]
            )

    def perceive(self, obs: Obs) -> Frame:
        network: Network = self.model
        frame = Frame(dict(self._begun().prompt))
        for name, image in camera_images(obs, network.cameras).items():
            frame.values[name] = self._pixels(name, image)
        for name, parts in network.vectors.items():
            option, length = network.options[name], network.length(name)
            if not option.parts and PREVIOUS not in parts:
                frame.values[name] = option.normalized(state_vector(obs, parts, length))
                continue
            # Raises what does not fit.
            state_vector(obs, [part for part in parts if part != PREVIOUS], length)
            pieces = [
                network.previous if part == PREVIOUS else state_vector(obs, [part])
                for part in parts
            ]
            if PREVIOUS in parts:
                frame.gaps[name] = sum(map(len, pieces[: parts.index(PREVIOUS)]))
            try:
                pieces = [
                    option.normalized(piece, part)
                    for piece, part in zip(pieces, parts, strict=True)
                ]
            except ValueError as error:
                raise InvalidObservation(
                    f"state: the statistics of {name!r} do not fit its parts: {error}"
                ) from error
            frame.values[name] = np.concatenate(pieces)
        return frame

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        network, config = self.model, self.config
        found = []
        for row, outputs in zip(rows, network.run([self._feed(row) for row in rows]), strict=True):
            action = network.chunk(outputs)
            if network.remembers:
                row.memory[_STEP] = row.memory.get(_STEP, 0) + 1
                row.memory[PREVIOUS] = action.ravel()
                row.memory[_RECURRENT] = {
                    name: outputs[later].copy() for name, later in config.recurrent.items()
                }
            found.append(
                Prediction(
                    config.action.unnormalized(action),
                    info={name: outputs[name] for name in config.info},
                )
            )
        return found

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        rng, options = np.random.default_rng(seed), self.model.options
        one_frame = {
            name: tensor.random(rng).ravel()[: tensor.size // options[name].history]
            for name, tensor in self.model.graph.inputs.items()
        }
        return Row((Frame(one_frame),), instruction, rng)

    def _feed(self, row: Row) -> dict[str, np.ndarray]:
        """Return the inputs of a row, with a batch of one."""
        network: Network = self.model
        for frame in row.frames:
            for name, start in frame.gaps.items():
                previous = network.options[name].normalized(
                    row.memory.get(PREVIOUS, network.previous), PREVIOUS
                )
                frame.values[name][start : start + len(previous)] = previous
            frame.gaps = {}
        feed = {}
        for name, tensor in network.inputs.items():
            option = network.options[name]
            if name in self.config.recurrent:
                value = row.memory.get(_RECURRENT, {}).get(name, tensor.zeros())
            elif option.step is not None:
                value = np.full(tensor.row, option.step + row.memory.get(_STEP, 0))
            elif option.noise:
                value = row.noise(*tensor.row)
            else:
                value = np.stack(
                    [frame.values[name] for frame in row.history(option.history)]
                ).reshape(tensor.row)
            feed[name] = value.astype(tensor.dtype, copy=False)
        return feed

    def _pixels(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return an image (H, W, 3) uint8 as the model's input, without its batch."""
        network: Network = self.model
        option, tensor, size = network.options[name], network.graph.inputs[name], network.size(name)
        if option.resize:
            image = resize_with_pad(image, *size)
        if image.shape[:2] != size:
            raise InvalidObservation(
                f"camera {network.cameras[name]!r}: got {image.shape[0]}x{image.shape[1]}, want "
                f"{size[0]}x{size[1]}; send that size, or set `resize: true` for the input {name!r}"
            )
        if tensor.dtype != np.uint8:
            low, high = map(np.float32, option.range)
            image = option.normalized(
                image.astype(np.float32) * (high - low) / np.float32(255) + low
            )
        return image.copy() if tensor.row[-1] == 3 else image.transpose(2, 0, 1).copy()
