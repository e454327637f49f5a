"""What OpenVLA and OpenVLA-OFT have in common as policies: settings, the dataset an answer is for, the contract."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import ActionSpec
from vlagents_ray.errors import InvalidObservation, NotReset
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelConfig, ModelPolicy, Prediction, Row
from vlagents_ray.policies.openvla.prismatic import Prismatic
from vlagents_ray.policies.openvla.statistics import Scale, Statistics

UNNORM_KEY = "unnorm_key"  # of reset's options and of an observation's info, as OpenVLA's clients send it
_SINGLE_ARM = 7  # six numbers of a motion, and the gripper's


class PrismaticConfig(ModelConfig):
    """Settings of both."""

    compile: Literal[False] = Field(default=False, description="not for this family: prompts' lengths vary too much")
    unnorm_key: str | None = Field(
        default=None,
        description="dataset whose statistics turn answers into physical units, with or without `_no_noops`; unset: "
        "the checkpoint's only one, or the one that `reset` or an observation names",
    )
    source_dir: str | None = Field(
        default=None,
        description="a clone of openvla or openvla-oft, for the model's classes; unset: $OPENVLA_SRC, "
        "$OPENVLA_OFT_SRC, or an installed `prismatic`",
    )
    trust_remote_code: bool = Field(
        default=False,
        description="run the Python code that lies in the checkpoint's folder instead: whoever can write there, or in "
        "the hub's repository, can do on this machine whatever this process can",
    )
    attention: Literal["sdpa", "eager", "flash_attention_2"] = Field(
        default="sdpa", description="of the language model; flash_attention_2 needs the package flash-attn and a GPU"
    )

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.trust_remote_code and self.source_dir:
            raise ValueError("source_dir and trust_remote_code: got both, want the model's classes from one of them")
        return self


@dataclass(frozen=True, slots=True)
class Asked:
    """A row that can be answered."""

    row: Row
    scale: Scale  # of its dataset's actions
    question: Any  # what the model gets


@dataclass(frozen=True, slots=True)
class Answer:
    """A chunk (H, D) in [-1, 1], and the distribution that it is the likeliest of, where the model states one."""

    values: np.ndarray
    mean: np.ndarray | None = None
    spread: np.ndarray | None = None

    def prediction(self, scale: Scale) -> Prediction:
        """In physical units."""
        return Prediction(
            scale.restore(self.values),
            None if self.mean is None else scale.restore(self.mean),
            None if self.spread is None else scale.restore_spread(self.spread),
        )


class PrismaticPolicy(ModelPolicy):
    """Answers what can be answered of a batch in one go, each row in the units of its own dataset."""

    config: Any

    @property
    @abc.abstractmethod
    def _checkpoint(self) -> Prismatic | None:
        """None before it is loaded."""

    @abc.abstractmethod
    def _question(self, row: Row, key: str) -> Any:
        """What the model gets of a row for that dataset; an error that it raises fails that row alone."""

    @abc.abstractmethod
    def _answer(self, asked: Sequence[Asked]) -> list[Answer]:
        """All of them in one batch."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode; `kwargs` may carry `unnorm_key`, the dataset that its actions are of."""
        told = super().reset(obs, instruction, **kwargs)
        self._begun().memory[UNNORM_KEY] = self._named(kwargs)
        return told

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """One chunk a row."""
        results: dict[int, Prediction | Exception] = {}
        asked: dict[int, Asked] = {}
        for i, row in enumerate(rows):
            try:
                key = self._key(row)
                asked[i] = Asked(row, self._statistics.scale(key), self._question(row, key))
            except Exception as error:  # noqa: BLE001 - handed to the session whose request failed
                results[i] = error
        answers = self._answer(list(asked.values())) if asked else []
        for (i, ask), answer in zip(asked.items(), answers, strict=True):
            results[i] = answer.prediction(ask.scale)
        return [results[i] for i in range(len(rows))]

    @property
    def _statistics(self) -> Statistics:
        checkpoint = self._checkpoint
        if checkpoint is None:
            raise NotReset(f"{type(self).__name__}: not loaded; call initialize() first")
        return checkpoint.statistics

    def _named(self, options: Mapping[str, Any]) -> str | None:
        """The dataset that `options` name, if they do."""
        key = options.get(UNNORM_KEY)
        if key is None:
            return None
        if not isinstance(key, str):
            raise InvalidObservation(f"unnorm_key: got {type(key).__name__}, want a dataset's name")
        return self._statistics.key(key)

    def _key(self, row: Row) -> str:
        """The dataset that a row is for: the observation's, the episode's, the config's, or the only one."""
        return self._statistics.key(self._named(row.info) or row.memory.get(UNNORM_KEY) or self.config.unnorm_key)

    def _action(self) -> ActionSpec:
        """One row: what its numbers mean depends on the dataset, but for the gripper of a single arm."""
        dims = set() if self._checkpoint is None else self._statistics.action_dims(self.config.unnorm_key)
        dim = dims.pop() if len(dims) == 1 else None
        single = dim == _SINGLE_ARM
        return ActionSpec(dim=dim, gripper_open=1.0 if single else None, gripper_closed=0.0 if single else None)
