"""The settings of an exported policy: the source of each input, and the meaning of the outputs."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, Field, PrivateAttr, model_validator
from typing_extensions import Self

from vlagents_ray.policies.base import ModelConfig

Numbers = float | list[float]
SOURCES = ("state", "constant", "step", "noise", "instruction")  # fields of `Input`


class Scaling(BaseModel, extra="forbid"):
    """The conversion of the robot's numbers to the model's, (x - mean) / std, and of the action's numbers back."""

    mean: Numbers | dict[str, Numbers] = Field(
        default=0.0, description="one for all, a list, or either by part of the state; of an action, its offset"
    )
    std: Numbers | dict[str, Numbers] = Field(default=1.0, description="as `mean`; of an action, its scale")
    min: Numbers | dict[str, Numbers] | None = Field(default=None, description="with `max`, becomes -1 in the model")
    max: Numbers | dict[str, Numbers] | None = Field(default=None, description="with `min`, becomes 1 in the model")
    clip: tuple[float, float] | None = Field(default=None, description="limits of the model's numbers")
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
        """Return the robot's numbers, float32, as the model's; `part` is the name of the part of the state."""
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
            return np.asarray(value.get(part, usual) if isinstance(value, dict) else value, np.float32)

        if part not in self._known:
            if self.min is None:
                self._known[part] = named(self.mean, 0.0), named(self.std, 1.0)
            else:
                low, high = named(self.min, -1.0), named(self.max, 1.0)
                self._known[part] = (high + low) / 2, (high - low) / 2
        return self._known[part]


class Input(Scaling):
    """The source of an input that is neither a camera nor the state, and the conversion of any input."""

    state: list[str] | None = Field(default=None, description="as the policy's `state`, for one of several vectors")
    constant: float | list[Any] | None = Field(default=None, description="the same numbers in each act")
    step: float | None = Field(default=None, description="a counter of the session's passes, which begins with this")
    noise: Literal[True] | None = Field(default=None, description="standard normal numbers, by the session's seed")
    instruction: Literal["text", "tokens", "mask"] | None = Field(
        default=None, description="a string, or the ids by tokenizer.json beside the file, or the mask of the ids"
    )
    history: int = Field(default=1, ge=1, description="how many of the last observations it holds, oldest first")
    shape: list[int] | None = Field(
        default=None, description="for a file that leaves lengths open, as all TorchScript does; -1 is the batch"
    )
    range: tuple[float, float] = Field(default=(0.0, 1.0), description="of an image that is not uint8")
    resize: bool = Field(default=False, description="take images of any size, and pad them with black")

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        named = [name for name in SOURCES if getattr(self, name) is not None]
        if len(named) > 1:
            raise ValueError(f"got {named}, want one source of an input")
        return self


class Action(Scaling):
    """The output that is the action: offset (`mean`) plus scale (`std`) times the model's numbers."""

    output: str | None = Field(default=None, description="its name; unset: the only one that nothing else names")


class OnnxConfig(ModelConfig):
    """Settings of an exported policy, in addition to those of all models."""

    checkpoint: str = Field(
        min_length=1,
        description="an .onnx file or a TorchScript archive (.pt, .jit), or a folder or org/name@COMMIT of the hub "
        "with one; `{step}` stands for checkpoint_step",
    )
    trust_checkpoint: bool = Field(
        default=False, description="a TorchScript archive is a program: set true if you trust its author"
    )
    dtype: Literal["auto"] = Field(default="auto", description="the file's")
    compile: Literal[False, "auto"] = Field(default="auto", description="nothing to compile: the runtime optimises it")
    threads: int = Field(default=1, ge=0, description="of ONNX Runtime on a CPU; 0: its own choice")

    cameras: dict[str, str] | None = Field(default=None, description="each input that is an image -> your camera")
    state: list[str] | None = Field(
        default=None,
        description="parts of the one input that no other setting names, in their order; 'previous_output' is the last "
        "action before offset and scale, zeros at first",
    )
    inputs: dict[str, Input] = Field(default={}, description="the source and the conversion of an input, by its name")
    recurrent: dict[str, str] = Field(default={}, description="each input that is a later output -> that output")
    outputs: list[str] = Field(default=["action"], description="names for a TorchScript archive's results, in order")
    action: Action = Field(default=Action(), description="which output is the action, its offset and its scale")
    info: list[str] = Field(default=[], description="outputs that an act returns in its info")
    contract: dict[str, Any] = Field(
        default={}, description="facts that the file lacks: {control_hz: 50, action: {space: joint, delta: false}}"
    )
    burn_in: int = Field(
        default=32,
        ge=1,
        le=256,
        description="last observations from which a memory is computed again, if the session's replica is lost",
    )
