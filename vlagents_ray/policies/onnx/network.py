"""A graph with the meaning of its inputs and outputs, and batches of rows through it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation, MalformedMessage
from vlagents_ray.policies.base.model_inputs import needs_gripper, state_specs
from vlagents_ray.policies.onnx.config import SOURCES, Input, OnnxConfig, Scaling
from vlagents_ray.policies.onnx.graph import TOKENIZER, Arrays, OnnxGraph, TorchScript, first_line
from vlagents_ray.registry import require

log = logging.getLogger(__name__)

PREVIOUS = "previous_output"  # the part of the state that is the model's last action, in the model's numbers
_TOLERANCE = 1e-3  # of outputs alone and in a batch, relative to the largest: more than another order of sums changes


class Network:
    """A graph whose inputs and outputs have a meaning; all sessions share it, and change nothing in it."""

    def __init__(self, graph: OnnxGraph | TorchScript, path: Path, config: OnnxConfig) -> None:
        """Map the inputs and outputs, and try the graph on random rows; raises `ConfigError` if they do not fit."""
        self.graph, self.config, self.cameras = graph, config, config.cameras or {}
        self.options = {name: config.inputs.get(name, Input()) for name in graph.inputs}
        self.vectors = {name: one.state for name, one in self.options.items() if one.state is not None}
        self._require_mapped()
        self._require_used()
        self.constants = {name: self._constant(name) for name, one in self.options.items() if one.constant is not None}
        self.inputs = {name: one for name, one in graph.inputs.items() if name not in self.constants}
        self.tokenizer = self._tokenizer(path)
        self.batched = False
        example = self._try_rows()
        for name, later in config.recurrent.items():
            if example[later].shape != graph.inputs[name].row:
                raise ConfigError(
                    f"recurrent: {{{name}: {later}}}: got an output {example[later].shape} for an input "
                    f"{graph.inputs[name].row}, want equal shapes; name the output that is the input's next value"
                )
        self.previous = np.zeros(example[self.action].size, np.float32)
        self._require_fitting(example)
        self.contract = self._contract(*self.chunk(example).shape)

    @cached_property
    def remembers(self) -> bool:
        """Whether an act depends on earlier ones of its session, other than by `history`."""
        steps = any(one.step is not None for one in self.options.values())
        return steps or bool(self.config.recurrent) or any(PREVIOUS in parts for parts in self.vectors.values())

    @cached_property
    def action(self) -> str:
        """The output that is the action."""
        others = {*self.config.recurrent.values(), *self.config.info}
        return self.config.action.output or next(name for name in self.graph.outputs if name not in others)

    def chunk(self, outputs: Arrays) -> np.ndarray:
        """Return the action in a row's outputs as a new array (H, D) float32, in the model's numbers."""
        output, clip = outputs[self.action], self.config.action.clip
        rows = output.reshape(-1, output.shape[-1] if output.ndim else 1).astype(np.float32)
        return rows if clip is None else rows.clip(*clip)

    def length(self, name: str) -> int:
        """Return how many numbers of a vector come from one observation, without the previous output."""
        previous = PREVIOUS in self.vectors[name]
        return self.graph.inputs[name].size // self.options[name].history - len(self.previous) * previous

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
                        f"instruction: got {len(ids)} tokens, want at most {tensor.size}; shorten it"
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
        feeds = {name: np.concatenate([row[name] for row in rows], one.axis) for name, one in self.inputs.items()}
        for name, value in self.constants.items():
            axis = self.graph.inputs[name].axis
            feeds[name] = value if axis is None else np.repeat(value, len(rows), axis)
        together = self.graph.run(feeds)
        split = {name: np.split(together[name], len(rows), axis) for name, axis in self._used.items()}
        return [{name: parts[i] for name, parts in split.items()} for i in range(len(rows))]

    def _try_rows(self) -> dict[str, np.ndarray]:
        """Find out whether rows may share a pass, and return the outputs of one."""
        recurrent = {later: self.graph.inputs[name].axis or 0 for name, later in self.config.recurrent.items()}
        self._used = dict.fromkeys((self.action, *self.config.info), 0) | recurrent  # with the batch's dimension
        rng = np.random.default_rng(0)
        rows = [{name: one.random(rng) for name, one in self.inputs.items()} for _ in range(2)]
        try:
            *alone, again = self.run([*rows, rows[0]])
        except ConfigError:
            raise
        except Exception as error:  # of the runtimes' many classes
            shapes = ", ".join(f"{name} {one.row} {one.dtype}" for name, one in self.inputs.items())
            raise ConfigError(f"the file fails on {shapes}: {first_line(error)}") from error
        if not _close(alone[0], again):
            raise ConfigError(
                "the file computes another output from the same inputs: it draws noise, or keeps a state, in which "
                "sessions would mix; export that as an input (`noise: true`, or `recurrent`)"
            )
        self.batched = all(one.axis is not None for one in self.inputs.values())
        try:
            self.batched = self.batched and all(map(_close, alone, self.run(rows)))
            why = "rows change each other in it"  # as those of a sequence, if its length is open and not the batch
        except Exception as error:  # noqa: BLE001 - an open length may be another than the batch's
            self.batched, why = False, first_line(error)
        if not self.batched and all(one.axis is not None for one in self.inputs.values()):
            log.warning("rows are computed one by one, as the file's open dimension is no batch: %s", why)
        return alone[0]

    def _require_mapped(self) -> None:
        """Give the one input that nothing names the parts in `state`; raises `ConfigError` unless all are mapped."""
        config, inputs, outputs = self.config, self.graph.inputs, self.graph.outputs
        sourced = [name for name, one in config.inputs.items() if one.model_fields_set & {*SOURCES}]
        named = [*self.cameras, *config.recurrent, *sourced]
        left = [name for name in inputs if name not in named] or ["state"] * (config.state is not None)
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
            "one of them the action": [] if config.action.output or len(free) == 1 else free or ["none of the outputs"],
        }
        said = "; ".join(f"{what}: {names}" for what, names in problems.items() if names)
        if said:
            raise ConfigError(
                f"the file has inputs {', '.join(f'{name} {one.shape}' for name, one in inputs.items())} and outputs "
                f"{outputs}, which the settings do not fit, {said}; name each input in `cameras`, `recurrent` or "
                f"`inputs`, but for one, which has the parts in `state`, and the output in `action`"
            )

    def _require_used(self) -> None:
        """Raise `ConfigError` for an option that its input does not use, and a part that it does not have."""
        unused = {"action": self.config.action.parts}
        for name, one in self.config.inputs.items():
            usable = {"shape", *SOURCES}
            if name in {*self.vectors, *self.cameras}:
                usable |= {"history", *Scaling.model_fields}
            if name in self.cameras:
                raw = self.graph.inputs[name].dtype == np.uint8
                usable = (usable - {*Scaling.model_fields} if raw else usable | {"range"}) | {"resize"}
            unused[f"inputs: {name}"] = (one.model_fields_set - usable) | (one.parts - {*self.vectors.get(name, ())})
        for where, names in unused.items():
            if names:
                raise ConfigError(f"{where}: has no use of {sorted(names)}; leave it out, or correct the name")

    def _constant(self, name: str) -> np.ndarray:
        tensor, value = self.graph.inputs[name], self.options[name].constant
        try:
            return np.broadcast_to(np.asarray(value, tensor.dtype), tensor.row).copy()
        except ValueError as error:
            raise ConfigError(f"inputs: {name}: constant: got {value}, want numbers of {tensor.row}") from error

    def _require_fitting(self, example: Arrays) -> None:
        """Raise `ConfigError` unless images are images, and lists of statistics as long as their numbers."""
        scaled: list[tuple[str, Any, Any]] = [("action", self.config.action.unnormalized, self.chunk(example))]
        for name in self.cameras:
            tensor, (height, width) = self.graph.inputs[name], self.size(name)
            if len(tensor.shape) < 4 or tensor.size != self.options[name].history * height * width * 3:
                raise ConfigError(
                    f"cameras: {name}: got an input {tensor.shape}, want (-1, 3, H, W) or (-1, H, W, 3), with "
                    f"`history` images before them; is it an image?"
                )
            scaled.append((f"inputs: {name}", self.options[name].normalized, np.zeros((1, 3))))
        for name, parts in self.vectors.items():
            if self.length(name) < 0 or parts.count(PREVIOUS) > 1:
                raise ConfigError(f"inputs: {name}: {PREVIOUS} has {len(self.previous)} numbers, which do not fit in")
            values = self.previous if PREVIOUS in parts else np.zeros(self.length(name))
            scaled.append((f"inputs: {name}", self.options[name].normalized, values))
        for where, convert, values in scaled:
            try:
                fits = convert(values).shape == values.shape
            except ValueError:
                fits = False
            if not fits:
                raise ConfigError(
                    f"{where}: got lists of statistics of another length, want {values.shape[-1]} numbers, or one for "
                    f"all; with {PREVIOUS}, statistics by part"
                )

    def _tokenizer(self, path: Path) -> Any:
        if not {"tokens", "mask"} & {one.instruction for one in self.options.values()}:
            return None
        if not path.with_name(TOKENIZER).is_file():
            raise ConfigError(f"{path.with_name(TOKENIZER)}: is missing, want that of the instruction, by `tokenizers`")
        tokenizer = require("tokenizers", extra="onnx").Tokenizer.from_file(str(path.with_name(TOKENIZER)))
        self.pad = (tokenizer.padding or {}).get("pad_id", 0)
        tokenizer.no_padding()
        tokenizer.no_truncation()
        return tokenizer

    def _contract(self, horizon: int, dim: int) -> Contract:
        config, state = self.config, {}
        for name, parts in self.vectors.items():
            state.update(state_specs([part for part in parts if part != PREVIOUS], self.length(name)))
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
            history=max([config.burn_in * self.remembers, *(one.history for one in self.options.values())]),
        )


def _close(found: Arrays, wanted: Arrays) -> bool:
    def close(one: np.ndarray, other: np.ndarray) -> bool:
        largest = np.abs(other[np.isfinite(other)]).max(initial=1)
        return one.shape == other.shape and np.allclose(one, other, rtol=0, atol=_TOLERANCE * largest, equal_nan=True)

    return all(close(found[name], one) for name, one in wanted.items())
