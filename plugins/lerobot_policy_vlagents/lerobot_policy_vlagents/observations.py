"""Converts observations with LeRobot's names to observations of the server's policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_policy_vlagents.configuration_vlagents import VlagentsConfig
from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec, require_match
from vlagents_ray.dataset_contract import divided_state, state_parts, wanted_parts
from vlagents_ray.errors import ConfigError, ContractMismatch
from vlagents_ray.naming import did_you_mean

# Key of the image of an environment with one camera; with several cameras the keys are
# `observation.images.NAME`.
_IMAGE = "observation.image"
_STATES = (OBS_STATE, OBS_ENV_STATE)
_STATE_OPTION = "--policy.state='[joints, gripper]'"


class ObservationMapping:
    """The mapping of the observations' features to the policy's cameras and states."""

    def __init__(
        self,
        config: VlagentsConfig,
        policy: Contract | None,
        shapes: Mapping[str, Sequence[int]],
        names: Sequence[str],
    ) -> None:
        """Map features to the policy's inputs.

        Args:
            config: The options.
            policy: The contract of the server's policy; None if it has none.
            shapes: The shape of each feature, without the batch's dimension: images (C, H, W),
                states (D,).
            names: The names of the values in `observation.state`; empty if they are unknown.

        Raises:
            ConfigError: The options name a missing camera, or the state cannot be divided into
                parts.
        """
        self._shapes = shapes
        robots = {_short(key): key for key in shapes if key.startswith(_IMAGE)}
        if unknown := [name for name in config.cameras.values() if name not in robots]:
            raise ConfigError(
                f"policy.cameras: expected only the cameras here, {sorted(robots)}, got "
                f"{unknown[0]!r}{did_you_mean(unknown[0], robots)}"
            )
        known = {name: key for name, key in robots.items() if name not in config.cameras.values()}
        known |= {name: robots[robot] for name, robot in config.cameras.items()}
        wanted = None if policy is None else policy.cameras
        self.cameras = {
            name: key for name, key in known.items() if wanted is None or name in wanted
        }
        self.unused = sorted(
            _short(key) for key in set(robots.values()) - set(self.cameras.values())
        )
        self._cameras_here = known
        self.parts = _parts(
            config, policy, {key: shapes[key][0] for key in _STATES if key in shapes}, names
        )

    def contract(
        self, action_dim: int | None, control_hz: float | None, action_names: Sequence[str] = ()
    ) -> Contract:
        """Return the contract of the robot or the environment, as far as LeRobot describes it."""
        sizes = {name: self._shapes[key][1:] for name, key in self._cameras_here.items()}
        listed = [part for parts in self.parts.values() for part in parts]
        return Contract(
            cameras={name: CameraSpec(height, width) for name, (height, width) in sizes.items()},
            state={part: StateSpec(dim) for part, dim in listed if part != "gripper"},
            gripper=any(part == "gripper" for part, _ in listed),
            action=ActionSpec(dim=action_dim, names=tuple(action_names) or None),
            control_hz=control_hz,
        )

    def observation(self, batch: Mapping[str, Any], row: int) -> Obs:
        """Return one row of a batch as an observation."""
        vectors = {
            key: batch[key][row].detach().to("cpu", torch.float32).numpy() for key in self.parts
        }
        state, gripper = divided_state(vectors, self.parts)
        return Obs(
            {name: _image(batch[key][row]) for name, key in self.cameras.items()}, gripper, state
        )


def shapes_of_batch(batch: Mapping[str, Any]) -> dict[str, Sequence[int]]:
    """Return the shape of each image and each state in a batch, without the batch's dimension."""
    read = {key: value for key, value in batch.items() if key in _STATES or key.startswith(_IMAGE)}
    return {
        key: tuple(value.shape[1:])
        for key, value in read.items()
        if isinstance(value, torch.Tensor)
    }


def shapes_of_features(features: Mapping[str, PolicyFeature]) -> dict[str, Sequence[int]] | None:
    """Return the shapes of images and states; None if LeRobot composes the state later."""
    states = {key for key, feature in features.items() if feature.type is FeatureType.STATE}
    if states - {OBS_STATE}:
        return None  # In LIBERO, LeRobot joins these values to `observation.state` at each step.
    return {
        key: feature.shape
        for key, feature in features.items()
        if key in _STATES or key.startswith(_IMAGE)
    }


def require_fit(policy: Contract | None, here: Contract) -> None:
    """Raise `ContractMismatch` with every difference between the server's policy and the robot
    or environments here.
    """
    try:
        require_match(policy, here)
    except ContractMismatch as error:
        raise ContractMismatch(
            f"{error}\n"
            "The env is what this command drives. --policy.cameras='{POLICY: ROBOT, …}' renames "
            f"cameras, {_STATE_OPTION} names the parts of observation.state, --dataset.fps is the "
            "control rate."
        ) from error


def _parts(
    config: VlagentsConfig, policy: Contract | None, widths: Mapping[str, int], names: Sequence[str]
) -> dict[str, list[tuple[str, int]]]:
    """Return, for each feature that is a state, its parts in order, with their sizes."""
    found: dict[str, list[tuple[str, int]]] = {}
    if OBS_ENV_STATE in widths:
        part = OBS_ENV_STATE.rpartition(".")[2]
        found[OBS_ENV_STATE] = [(part, widths[OBS_ENV_STATE])]
        if policy is not None and policy.state is not None:
            policy = replace(
                policy, state={name: spec for name, spec in policy.state.items() if name != part}
            )
    if OBS_STATE in widths:
        wanted, chosen = wanted_parts(policy), list(config.state)
        if not chosen and len(wanted) > 1:
            chosen = [
                part
                for part, _ in groupby(
                    name.rstrip("0123456789").removesuffix("_") for name in names
                )
            ]
            if sorted(chosen) != sorted(wanted):
                raise ConfigError(
                    f"observation.state: expected the parts {wanted} of the policy, got the "
                    f"values {list(names) or 'without names'}; name the parts in the order of the "
                    f"vector: {_STATE_OPTION}"
                )
        found[OBS_STATE] = state_parts(
            widths[OBS_STATE], policy, chosen or None, option=_STATE_OPTION
        )
    return found


def _short(key: str) -> str:
    return key.removeprefix(f"{OBS_IMAGES}.").removeprefix("observation.")


def _image(tensor: torch.Tensor) -> np.ndarray:
    """Convert an image (C, H, W) in [0, 1], which LeRobot computed from bytes, back to these bytes,
    (H, W, C) uint8.
    """
    if tensor.is_floating_point():
        tensor = (
            (tensor.detach().to("cpu", torch.float32) * 255).round().clamp(0, 255).to(torch.uint8)
        )
    array: np.ndarray = tensor.cpu().permute(1, 2, 0).contiguous().numpy()
    return array
