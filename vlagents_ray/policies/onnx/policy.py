"""Exported policies of any kind: each session keeps its recurrent state, and all share a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.model_inputs import camera_images, resize_with_pad, state_vector
from vlagents_ray.policies.onnx.config import OnnxConfig
from vlagents_ray.policies.onnx.graph import read_graph
from vlagents_ray.policies.onnx.network import PREVIOUS, Network

_STEP, _RECURRENT = "step", "recurrent"  # keys in a session's memory, beside PREVIOUS


@dataclass(slots=True)
class Frame:
    """The inputs of one observation."""

    values: dict[str, np.ndarray]
    gaps: dict[str, int] = field(default_factory=dict)  # where PREVIOUS belongs in a vector, until an act fills it


class Onnx(ModelPolicy):
    """An exported policy. Its memory is a step counter, the previous output, and the recurrent inputs."""

    Config: ClassVar[type] = OnnxConfig
    config: OnnxConfig

    @property
    def history(self) -> int:
        return 1 if self.model is None else max((one.history for one in self.model.options.values()), default=1)

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
            self.predict([Row(tuple(episode.frames), episode.instruction, episode.rng, memory=episode.memory)])

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
            state_vector(obs, [part for part in parts if part != PREVIOUS], length)  # raises what does not fit
            pieces = [network.previous if part == PREVIOUS else state_vector(obs, [part]) for part in parts]
            if PREVIOUS in parts:
                frame.gaps[name] = sum(map(len, pieces[: parts.index(PREVIOUS)]))
            try:
                pieces = [option.normalized(piece, part) for piece, part in zip(pieces, parts, strict=True)]
            except ValueError as error:
                raise InvalidObservation(f"state: the statistics of {name!r} do not fit its parts: {error}") from error
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
                row.memory[_RECURRENT] = {name: outputs[later].copy() for name, later in config.recurrent.items()}
            found.append(
                Prediction(config.action.unnormalized(action), info={name: outputs[name] for name in config.info})
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
                previous = network.options[name].normalized(row.memory.get(PREVIOUS, network.previous), PREVIOUS)
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
                value = np.stack([frame.values[name] for frame in row.history(option.history)]).reshape(tensor.row)
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
                f"camera {network.cameras[name]!r}: got {image.shape[0]}x{image.shape[1]}, want {size[0]}x{size[1]}; "
                f"send that size, or set `resize: true` for the input {name!r}"
            )
        if tensor.dtype != np.uint8:
            low, high = map(np.float32, option.range)
            image = option.normalized(image.astype(np.float32) * (high - low) / np.float32(255) + low)
        return image.copy() if tensor.row[-1] == 3 else image.transpose(2, 0, 1).copy()
