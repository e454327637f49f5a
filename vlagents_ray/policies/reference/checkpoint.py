"""A checkpoint of the reference policy, a folder with `model.safetensors` and `config.json`.

`Checkpoint` describes `config.json`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from vlagents_ray.errors import ConfigError, InvalidObservation

CAMERAS = ("scene", "wrist")  # the model's cameras, in the order of its image encoders
CONFIG, WEIGHTS = "config.json", "model.safetensors"
# Smallest standard deviation of a value of the state. With this limit, a value that never changed
# in training stays near zero.
_LEAST_STD = 1e-2


class NetworkSizes(BaseModel, extra="forbid", frozen=True):
    """The sizes of a network; by default 3.9 million parameters."""

    words: int  # number of words in the vocabulary
    longest: int = 16  # number of words of the longest instruction
    side: int = 64  # px, side of an image
    patch: int = 12  # px, side of the patch of an image token
    stride: int = 8  # px, distance between two patches
    state: int = 8  # number of values of the state; shorter states are padded with zeros
    horizon: int = 8  # number of actions in a chunk
    action: int = 4  # number of values of an action
    token_width: int = 96  # width of an image token
    queries: int = 16  # number of queries
    width: int = 128  # width of a query
    looks: int = 2  # number of times that the queries attend to the images
    head: int = 256  # width of the flow's network
    blocks: int = 3  # number of blocks of the flow's network
    # Largest number of rows of the executed plan with which a chunk begins; 0: the network was not
    # trained with given rows, and has no input for them.
    longest_prefix: int = 0


class Embodiment(BaseModel, extra="forbid", frozen=True):
    """The cameras, the state and the action of one robot of a checkpoint."""

    cameras: dict[str, str]  # name in CAMERAS -> the robot's name
    state: list[str]  # parts of the proprioception, in order
    state_mean: list[float]
    state_std: list[float]
    action: dict[str, Any]  # the `ActionSpec` of the actions, which are in [-1, 1]


def words_of(instruction: str) -> list[str]:
    """Return the words of an instruction in lower case, without punctuation."""
    return re.findall(r"[\w-]+", instruction.lower())


class Checkpoint(BaseModel, extra="forbid", frozen=True):
    """The file `config.json` of a checkpoint."""

    sizes: NetworkSizes
    words: list[str]  # words of instructions; the first one has the token 1, since 0 is padding
    embodiments: dict[str, Embodiment]

    def tokens(self, instruction: str) -> np.ndarray:
        """Return the tokens of an instruction, (longest,) int64, 0 after its last word.

        Raises:
            InvalidObservation: The instruction has a word that is not in the vocabulary, or too
                many words.
        """
        words = words_of(instruction)
        unknown = [word for word in words if word not in self.words]
        if unknown:
            raise InvalidObservation(
                f"instruction: expected words of {self.words}, got {unknown[0]!r} in "
                f"{instruction!r}"
            )
        if not 0 < len(words) <= self.sizes.longest:
            raise InvalidObservation(
                f"instruction: expected 1 to {self.sizes.longest} words, got {len(words)}"
            )

        tokens = np.zeros(self.sizes.longest, np.int64)
        tokens[: len(words)] = [self.words.index(word) + 1 for word in words]
        return tokens


def pixels(images: Any) -> Any:
    """Convert images to the input of the network.

    Args:
        images: A tensor, (P, cameras, S, S, 3) uint8.

    Returns:
        (P, cameras, 3, S, S) float32 in [-1, 1].
    """
    return images.movedim(-1, 2).float().div_(127.5).sub_(1.0)


def normalised(robot: Embodiment, state: np.ndarray, length: int) -> np.ndarray:
    """Return the states (…, D) of a robot in the units of the network, (…, length) float32."""
    units = (state - np.array(robot.state_mean)) / np.maximum(robot.state_std, _LEAST_STD)
    padded = np.zeros((*units.shape[:-1], length), np.float32)
    padded[..., : units.shape[-1]] = units
    return padded


def read_checkpoint(folder: Path) -> Checkpoint:
    """Read the `config.json` of a checkpoint; raises `ConfigError` if it is not valid."""
    try:
        return Checkpoint.model_validate_json((folder / CONFIG).read_text(encoding="utf-8"))
    except ValidationError as error:
        raise ConfigError(
            f"{folder / CONFIG}: expected a checkpoint of the reference policy, got an error: "
            f"{error}"
        ) from error
