"""The rows of a model, and their inputs from an observation: cameras, state vector, and requests
in `Obs.info`.
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
CLOSED = "gripper_closed"  # the part that is the closedness: 1 - `Obs.gripper`
KEPT = 256  # cached instructions with their tokens: more than a server has tasks
# Characters of a cached instruction, which clients choose: the cache takes at most about 10 MB.
KEPT_CHARACTERS = 1000


@dataclass(frozen=True, slots=True)
class Row:
    """One chunk to compute: the session's own, or a sample of its distribution."""

    # The results of `ModelPolicy.perceive` for the last observations, oldest first.
    frames: tuple[Any, ...]
    instruction: str
    rng: np.random.Generator  # of the session, so that other rows have no influence
    # (H', D) float32, real-time chunking: see LEFTOVER in the interface.
    leftover: np.ndarray | None = None
    delay: int = 0  # DELAY: the number of first rows of the chunk that are the leftover's
    info: Mapping[str, Any] = field(default_factory=dict)  # the observation's info
    # The session's memory, for families that store more than frames.
    memory: dict[str, Any] = field(default_factory=dict)
    want: tuple[str, ...] = ()  # requested outputs of the chunk, from the contract's `behaviour`
    # Whether the chunk is drawn from the distribution, as samples and requested outputs need it;
    # otherwise it is the likeliest one.
    sample: bool = False
    # Fingerprint of the session's adapter, see `ModelPolicy.adapters`; empty: no adapter.
    adapter: str = ""

    def noise(self, *shape: int) -> np.ndarray:
        """Draw standard normal numbers, float32, which are the same on every device."""
        return self.rng.standard_normal(shape, dtype=np.float32)

    def history(self, length: int) -> tuple[Any, ...]:
        """Return the last `length` frames; at the beginning of an episode, repeat its first one."""
        return (self.frames[0],) * (length - len(self.frames)) + self.frames[-length:]


def drawn(row: Row, draws: np.random.Generator) -> Row:
    """Return the row with noise and memory that are separate from the session's."""
    return replace(row, rng=draws, memory=copy.deepcopy(row.memory), sample=True)


def shared_frames(rows: Sequence[Row]) -> tuple[list[int], list[int]]:
    """Return the rows to encode: the samples of a session share the observations of its row.

    Returns:
        The indices of rows with distinct observations, and for each row the index of its
        observations among them.
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
    """Map the model's name of each camera to the observation's: `chosen`, or the family's usual
    mapping.

    `known` are the model's cameras, in the order of the result. An unknown or missing camera raises
    `ConfigError`; it is never replaced by zeros.
    """
    mapping = usual if chosen is None else chosen
    if set(mapping) != set(known):
        example = ", ".join(f"{name}: …" for name in known)
        raise ConfigError(
            f"cameras: got {sorted(mapping)}, want {sorted(known)}, the checkpoint's own names, "
            f"each with the name of one of yours, as in cameras: {{{example}}}"
        )
    return {name: mapping[name] for name in known}


def camera_images(obs: Obs, cameras: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return the images by the model's names, (H, W, 3) uint8 RGB, not copied."""
    for ours in cameras.values():
        if ours not in obs.cameras:
            raise MissingCamera(ours, have=obs.cameras)
    return {name: obs.cameras[ours] for name, ours in cameras.items()}


def state_vector(obs: Obs, parts: Sequence[str], dim: int | None = None) -> np.ndarray:
    """Return parts of the proprioception as one new (dim,) float32 vector.

    Args:
        parts: The names of the parts in order; `GRIPPER` and `CLOSED` select `Obs.gripper`.
        dim: The length of the vector; None accepts any.

    Raises:
        MissingState, InvalidObservation: A part is missing, or the length is wrong.
    """
    values = []
    for name in parts:
        if name in (GRIPPER, CLOSED):
            if obs.gripper is None:
                raise InvalidObservation(
                    "gripper: got none, want a number in [0, 1] where 1 = open"
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
            f"state: got {len(vector)} numbers from {list(parts)}, want {dim}, as the checkpoint "
            "was trained; set the policy's `state` to the parts that it was trained with"
        )
    return vector


def needs_gripper(parts: Sequence[str]) -> bool:
    """Return whether `Obs.gripper` is among the parts, for a contract."""
    return GRIPPER in parts or CLOSED in parts


def state_specs(parts: Sequence[str], dim: int | None = None) -> dict[str, StateSpec]:
    """Return the states of a contract: the parts, and the length of a part that is the whole
    vector.
    """
    names = [name for name in parts if name not in (GRIPPER, CLOSED)]
    is_whole_vector = list(parts) == names and len(names) == 1
    return {name: StateSpec(dim=dim if is_whole_vector else None) for name in names}


def wanted_samples(obs: Obs, config: ModelConfig) -> int:
    """Return the number of samples that an observation requests; raises `InvalidObservation` if
    the policy does not offer so many.
    """
    samples = count_in(obs, SAMPLES)
    if samples > config.max_samples:
        raise InvalidObservation(
            f"info[{SAMPLES!r}]: got {samples}, want at most {config.max_samples}; ask for fewer, "
            "or set the policy's `max_samples`"
        )
    if samples and config.actions != "chunk":
        raise InvalidObservation(
            f"info[{SAMPLES!r}]: got {samples} with actions: {config.actions}, want none; samples "
            "are of whole chunks, so set the policy's `actions` to 'chunk'"
        )
    return samples


def wanted_behaviour(obs: Obs) -> tuple[str, ...]:
    """Return the names of the extra outputs that an observation requests beside the action."""
    if WANT not in obs.info:
        return ()
    if obs.info.get(LEFTOVER) is not None:
        raise InvalidObservation(
            f"info[{WANT!r}]: got it with {LEFTOVER!r}, want one of them; a chunk that continues a "
            "plan is not drawn from the policy's distribution"
        )
    return tuple(obs.info[WANT])


def leftover_plan(obs: Obs, contract: Contract | None) -> np.ndarray:
    """Return a copy of the plan to continue, (H, D) float32, from an observation with a plan."""
    leftover = obs.info[LEFTOVER]
    dim = None if contract is None else contract.action.dim
    try:
        plan = np.array(leftover, np.float32)
    except (TypeError, ValueError):
        plan = np.zeros(0, np.float32)  # Values that are no numbers are rejected below.
    if plan.ndim != 2 or dim not in (None, plan.shape[1]) or not np.isfinite(plan).all():
        kind = leftover.shape if isinstance(leftover, np.ndarray) else type(leftover).__name__
        raise InvalidObservation(
            f"info[{LEFTOVER!r}]: got {kind}, want (H, {dim or 'D'}) finite float32"
        )
    return plan


def count_in(obs: Obs, name: str) -> int:
    """Return a number in an observation's info, by default 0; raises `InvalidObservation` if it
    is no int from 0.
    """
    value = obs.info.get(name) or 0
    if not isinstance(value, int | np.integer) or value < 0:
        raise InvalidObservation(f"info[{name!r}]: got {value!r}, want an int from 0")
    return int(value)


def resize_with_pad(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale the whole (H, W, 3) uint8 image and centre it on black (height, width, 3); always
    returns a copy.

    Bilinear, by Pillow, and rounded as in openpi's `image_tools.resize_with_pad`, which produced
    the training images of its policies.
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
    """Return `tokenize` with a cache of its results for recent instructions, except for very
    long ones.
    """
    cached = lru_cache(maxsize=KEPT)(tokenize)
    return lambda text: cached(text) if len(text) <= KEPT_CHARACTERS else tokenize(text)
