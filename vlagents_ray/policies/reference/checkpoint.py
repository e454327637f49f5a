"""A checkpoint of the reference policy: a folder with `model.safetensors`, and `config.json`,
see `Checkpoint`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from vlagents_ray.errors import ConfigError, InvalidObservation

CAMERAS = ("scene", "wrist")  # the model's, in the order of its image encoders
CONFIG, WEIGHTS = "config.json", "model.safetensors"
# Of a number of the state, so that one that never changed in training stays near zero.
_LEAST_STD = 1e-2


class NetworkSizes(BaseModel, extra="forbid", frozen=True):
    """The sizes of a network; by default 3.9 million parameters."""

    words: int  # of the vocabulary
    longest: int = 16  # words of an instruction
    side: int = 64  # px of an image
    patch: int = 12  # px, side of what an image token sees
    stride: int = 8  # px between two tokens
    state: int = 8  # numbers; a robot with fewer has zeros after them
    horizon: int = 8  # actions of a chunk
    action: int = 4  # numbers of an action
    token_width: int = 96
    queries: int = 16
    width: int = 128  # of a query
    looks: int = 2  # times that each query looks at the images
    head: int = 256  # width of the flow's network
    blocks: int = 3  # of the flow's network


class Embodiment(BaseModel, extra="forbid", frozen=True):
    """The cameras, the state and the action of one robot of a checkpoint."""

    cameras: dict[str, str]  # of CAMERAS -> the robot's
    state: list[str]  # parts of its proprioception, in order
    state_mean: list[float]
    state_std: list[float]
    action: dict[str, Any]  # the `ActionSpec` of its actions, which are in [-1, 1]


def words_of(instruction: str) -> list[str]:
    """Return the words of an instruction in lower case, without punctuation."""
    return re.findall(r"[\w-]+", instruction.lower())


class Checkpoint(BaseModel, extra="forbid", frozen=True):
    """The file `config.json` of a checkpoint."""

    sizes: NetworkSizes
    words: list[str]  # of instructions; the first one has the token 1, as 0 is padding
    embodiments: dict[str, Embodiment]

    def tokens(self, instruction: str) -> np.ndarray:
        """Return the tokens of an instruction, (longest,) int64, 0 after its last word.

        Raises:
            InvalidObservation: It has a word that the training did not have, or too many.
        """
        words = words_of(instruction)
        unknown = [word for word in words if word not in self.words]
        if unknown:
            raise InvalidObservation(
                f"instruction: got {unknown[0]!r} in {instruction!r}, want words of {self.words}"
            )
        if not 0 < len(words) <= self.sizes.longest:
            raise InvalidObservation(
                f"instruction: got {len(words)} words, want 1 to {self.sizes.longest}"
            )

        tokens = np.zeros(self.sizes.longest, np.int64)
        tokens[: len(words)] = [self.words.index(word) + 1 for word in words]
        return tokens


def pixels(images: Any) -> Any:
    """Return images as the network sees them, both of torch.

    Args:
        images: (P, cameras, S, S, 3) uint8.

    Returns:
        (P, cameras, 3, S, S) float32 in [-1, 1].
    """
    return images.movedim(-1, 2).float().div_(127.5).sub_(1.0)


def normalised(robot: Embodiment, state: np.ndarray, length: int) -> np.ndarray:
    """Return the states (…, D) of a robot in the units of the network, (…, length) float32."""
    units = (state - np.array(robot.state_mean)) / np.maximum(robot.state_std, _LEAST_STD)
    filled = np.zeros((*units.shape[:-1], length), np.float32)
    filled[..., : units.shape[-1]] = units
    return filled


def read_checkpoint(folder: Path) -> Checkpoint:
    """Return what a checkpoint's `config.json` states; raises `ConfigError`."""
    try:
        return Checkpoint.model_validate_json((folder / CONFIG).read_text(encoding="utf-8"))
    except ValidationError as error:
        raise ConfigError(
            f"{folder / CONFIG}: is no checkpoint of the reference policy: {error}"
        ) from error
