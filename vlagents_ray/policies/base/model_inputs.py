"""The rows of a model's batch, and their inputs.

The inputs are read from observations: cameras, the state vector, and requests in `Obs.info`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation, MissingCamera, MissingState
from vlagents_ray.interface import LEFTOVER, SAMPLES, WANT, Obs
from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.registry import require

T = TypeVar("T")

GRIPPER = "gripper"  # the part of the state that is `Obs.gripper`
CLOSED = "gripper_closed"  # the part of the state that is 1 - `Obs.gripper`
KEPT = 256  # number of instructions whose tokens are cached, more than a server needs
# Longest instruction that is cached, characters. Since clients choose the instructions, this limits
# the cache to about 10 MB.
KEPT_CHARACTERS = 1000
# Largest number of samples of its distribution that an observation may request, so that one request
# does not occupy the model for minutes.
MOST_SAMPLES = 1024


@dataclass(frozen=True, slots=True)
class Row:
    """One chunk to compute: the answer to a session, or a sample of the answer's distribution."""

    # The results of `ModelPolicy.perceive` for the last observations, oldest first.
    frames: tuple[Any, ...]
    instruction: str
    rng: np.random.Generator  # generator of the session, so that other rows have no influence
    # The leftover plan of real-time chunking, (H', D) float32: see LEFTOVER in the interface.
    leftover: np.ndarray | None = None
    # The number of rows at the beginning of the chunk that are equal to the leftover: see DELAY.
    delay: int = 0
    info: Mapping[str, Any] = field(default_factory=dict)  # the observation's info
    # The session's memory, for families that store more than frames.
    memory: dict[str, Any] = field(default_factory=dict)
    want: tuple[str, ...] = ()  # requested outputs of the chunk, from the contract's `behaviour`
    # Whether the chunk is drawn from the distribution, which samples and requested outputs require.
    # Otherwise, the most likely chunk is computed.
    sample: bool = False

    def noise(self, *shape: int) -> np.ndarray:
        """Draw standard normal numbers, float32, which are the same on every device."""
        return self.rng.standard_normal(shape, dtype=np.float32)

    def history(self, length: int) -> tuple[Any, ...]:
        """Return the last `length` frames; if there are fewer, the first frame is repeated."""
        return (self.frames[0],) * (length - len(self.frames)) + self.frames[-length:]


def drawn(row: Row, draws: np.random.Generator) -> Row:
    """Return a row for a sample, with a generator and a memory separate from the session's."""
    return replace(row, rng=draws, memory=copy.deepcopy(row.memory), sample=True)


def shared_frames(rows: Sequence[Row]) -> tuple[list[int], list[int]]:
    """Return which rows to encode.

    The samples of a session share the observations of the session's row.

    Returns:
        The indices of rows with distinct observations, and for each row the index of its
        observations among these.
    """
    owners: dict[int, int] = {}
    firsts: list[int] = []
    for i, row in enumerate(rows):
        if id(row.frames) not in owners:
            owners[id(row.frames)] = len(firsts)
            firsts.append(i)
    return firsts, [owners[id(row.frames)] for row in rows]


def choose_cameras(
    chosen: Mapping[str, str] | None, usual: Mapping[str, str], known: Sequence[str]
) -> dict[str, str]:
    """Map the model's name of each camera to the name in observations.

    Args:
        chosen: The mapping in the policy's settings; with None, `usual` applies.
        usual: The usual mapping of the model's family.
        known: The model's cameras, in the order of the result.

    Raises:
        ConfigError: A camera is unknown or missing. A missing camera is never replaced with zeros.
    """
    mapping = usual if chosen is None else chosen
    if set(mapping) != set(known):
        example = ", ".join(f"{name}: …" for name in known)
        raise ConfigError(
            f"cameras: expected a mapping of the checkpoint's cameras {sorted(known)}, got "
            f"{sorted(mapping)}; give each the name of one of yours, as in cameras: {{{example}}}"
        )
    return {name: mapping[name] for name in known}


def camera_images(obs: Obs, cameras: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the images by the model's camera names, (H, W, 3) uint8 RGB, without copying them."""
    for ours in cameras.values():
        if ours not in obs.cameras:
            raise MissingCamera(ours, have=obs.cameras)
    return {name: obs.cameras[ours] for name, ours in cameras.items()}


def state_vector(obs: Obs, parts: Sequence[str], dim: int | None = None) -> np.ndarray:
    """Return parts of the proprioception as one new vector.

    Args:
        obs: The observation.
        parts: The names of the parts in order; `GRIPPER` and `CLOSED` select `Obs.gripper`.
        dim: The length of the vector; None accepts any length.

    Returns:
        (dim,) float32.

    Raises:
        MissingState: A part is missing.
        InvalidObservation: The gripper is missing, or the length is wrong.
    """
    values = []
    for name in parts:
        if name in (GRIPPER, CLOSED):
            if obs.gripper is None:
                raise InvalidObservation(
                    "gripper: expected a number in [0, 1] where 1 = open, got None; set it in "
                    "the observation"
                )
            gripper = obs.gripper if name == GRIPPER else 1.0 - obs.gripper
            values.append(np.array([gripper], np.float32))
        elif name in obs.state:
            values.append(np.asarray(obs.state[name], np.float32))
        else:
            raise MissingState(name, have=obs.state)

    vector = np.concatenate(values) if values else np.zeros(0, np.float32)
    if dim is not None and vector.shape != (dim,):
        raise InvalidObservation(
            f"state: expected {dim} numbers, as the checkpoint was trained with, got "
            f"{len(vector)} from {list(parts)}; set the policy's `state` to the parts that it was "
            "trained with"
        )
    return vector


def needs_gripper(parts: Sequence[str]) -> bool:
    """Return whether the parts include `Obs.gripper`, for a contract."""
    return GRIPPER in parts or CLOSED in parts


def state_specs(parts: Sequence[str], dim: int | None = None) -> dict[str, StateSpec]:
    """Return the state of a contract.

    Args:
        parts: The parts of a state vector, as for `state_vector`.
        dim: The length of the vector. If there is only one part, this is also the length of that
            part.
    """
    names = [name for name in parts if name not in (GRIPPER, CLOSED)]
    is_whole_vector = list(parts) == names and len(names) == 1
    return {name: StateSpec(dim=dim if is_whole_vector else None) for name in names}


def wanted_samples(obs: Obs, config: ModelConfig) -> int:
    """Return the number of samples that an observation requests.

    Raises:
        InvalidObservation: The policy does not offer so many samples.
    """
    samples = count_in(obs, SAMPLES)
    if samples > MOST_SAMPLES:
        raise InvalidObservation(
            f"info[{SAMPLES!r}]: expected a number of at most {MOST_SAMPLES}, got {samples}; "
            "request fewer"
        )
    if samples and config.actions != "chunk":
        raise InvalidObservation(
            f"info[{SAMPLES!r}]: expected none with actions: {config.actions}, got {samples}; set "
            "the policy's `actions` to 'chunk', as samples are whole chunks"
        )
    return samples


def wanted_behaviour(obs: Obs) -> tuple[str, ...]:
    """Return the names of the outputs that an observation requests besides the action."""
    if WANT not in obs.info:
        return ()
    if obs.info.get(LEFTOVER) is not None:
        raise InvalidObservation(
            f"info[{WANT!r}]: expected no {LEFTOVER!r} with it, got both; leave one out, as a "
            "chunk that continues a plan is not drawn from the policy's distribution"
        )
    return tuple(obs.info[WANT])


def leftover_plan(obs: Obs, contract: Contract | None) -> np.ndarray:
    """Return a copy of the leftover plan in an observation, (H, D) float32."""
    leftover = obs.info[LEFTOVER]
    dim = None if contract is None else contract.action.dim
    try:
        plan = np.array(leftover, np.float32)
    except (TypeError, ValueError):
        plan = np.zeros(0, np.float32)  # Values that are not numbers are rejected below.
    if plan.ndim != 2 or dim not in (None, plan.shape[1]) or not np.isfinite(plan).all():
        content = leftover.shape if isinstance(leftover, np.ndarray) else type(leftover).__name__
        raise InvalidObservation(
            f"info[{LEFTOVER!r}]: expected (H, {dim or 'D'}) finite float32, got {content}"
        )
    return plan


def count_in(obs: Obs, name: str) -> int:
    """Return a number in an observation's info, 0 if it is missing.

    Raises:
        InvalidObservation: The value is not an int, or it is negative.
    """
    value = obs.info.get(name) or 0
    if not isinstance(value, int | np.integer) or value < 0:
        raise InvalidObservation(f"info[{name!r}]: expected an int of 0 or more, got {value!r}")
    return int(value)


def resize_with_pad(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale a whole image to fit into a size, and pad it with black.

    Pillow's bilinear interpolation is used, with the rounding of openpi's
    `image_tools.resize_with_pad`, which produced the training images of openpi's policies.

    Args:
        image: (H, W, 3) uint8.
        height: Height of the result, px.
        width: Width of the result, px.

    Returns:
        A new array, (height, width, 3) uint8, with the scaled image in its centre.
    """
    have_height, have_width = image.shape[:2]
    if (have_height, have_width) == (height, width):
        return image.copy()

    ratio = max(have_width / width, have_height / height)
    inner_height, inner_width = max(1, int(have_height / ratio)), max(1, int(have_width / ratio))
    pil = require("PIL.Image")
    small = pil.fromarray(np.ascontiguousarray(image)).resize(
        (inner_width, inner_height), pil.Resampling.BILINEAR
    )

    padded = np.zeros((height, width, 3), np.uint8)
    top, left = (height - inner_height) // 2, (width - inner_width) // 2
    padded[top : top + inner_height, left : left + inner_width] = small
    return padded


def keeping_tokens(tokenize: Callable[[str], T]) -> Callable[[str], T]:
    """Return `tokenize` with a cache of its results for recent instructions.

    Very long instructions are not cached.
    """
    cached_tokenize = lru_cache(maxsize=KEPT)(tokenize)

    def tokenize_with_cache(text: str) -> T:
        if len(text) > KEPT_CHARACTERS:
            return tokenize(text)
        return cached_tokenize(text)

    return tokenize_with_cache
