"""Diffusion Policy, with the sessions' real past frames and their own noise."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    camera_specs,
    choose_cameras,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.diffusion_policy.config import DiffusionPolicyConfig
from vlagents_ray.policies.diffusion_policy.network import OBS, DiffusionNetwork
from vlagents_ray.policies.diffusion_policy.noise import noise_of
from vlagents_ray.policies.diffusion_policy.passes import compile_with
from vlagents_ray.registry import require

USUAL_CAMERAS = {  # those of the authors' tasks
    "image": "front",
    "agentview_image": "front",
    "robot0_eye_in_hand_image": "wrist",
}
_POSE_NUMBERS = 10  # position, rotation in six numbers, gripper


class DiffusionPolicy(ModelPolicy):
    """The policy of a Diffusion Policy checkpoint, which calls the module's `predict_action` for a whole batch."""

    Config: ClassVar[type] = DiffusionPolicyConfig

    def __init__(self, config: DiffusionPolicyConfig) -> None:
        super().__init__(config)
        self.config: DiffusionPolicyConfig = config

    @property
    def history(self) -> int:
        return 1 if self.model is None else int(self.model.module.n_obs_steps)

    @property
    def contract(self) -> Contract:
        """The contract; before the checkpoint is loaded it states only that there is no instruction."""
        network: DiffusionNetwork | None = self.model
        if network is None:
            return Contract(instruction=False)
        parts, sizes = self._parts(network), network.vectors.values()
        own = {part: StateSpec(size) for part, size in zip(parts, sizes, strict=False)}
        return Contract(
            cameras=camera_specs(self._cameras(network)),
            state=own if self.config.state is None else state_specs(parts, self.state_dim),
            gripper=needs_gripper(parts),
            instruction=False,
            action=_action(network.module.action_dim, absolute=network.absolute),
            chunk=self.chunk(network.module.n_action_steps),
            history=self.history,
        )

    @property
    def state_dim(self) -> int | None:
        """The total length of the checkpoint's vectors; None before it is loaded."""
        return None if self.model is None else sum(self.model.vectors.values())

    def load(self) -> DiffusionNetwork:
        """Read the checkpoint; raises `ConfigError` for cameras that it does not have."""
        network = DiffusionNetwork.load(self.config)
        self._cameras(network)
        if self.config.compile:
            compile_with(network, self.compilation)
        return network

    def perceive(self, obs: Obs) -> dict[str, np.ndarray]:
        """Return images (H, W, 3) uint8 and vectors (D,) float32 by the checkpoint's names."""
        network: DiffusionNetwork = self.model
        seen = {
            name: _resized(image, *network.images[name])
            for name, image in camera_images(obs, self._cameras(network)).items()
        }
        vector = state_vector(obs, self._parts(network), self.state_dim)
        ends = np.cumsum([0, *network.vectors.values()])
        return seen | {name: vector[a:b] for name, (a, b) in zip(network.vectors, pairwise(ends), strict=True)}

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks of a batch, with the noise of each row's session."""
        network: DiffusionNetwork = self.model
        torch = require("torch")
        histories = [row.history(self.history) for row in rows]
        inputs = {}
        for name in histories[0][0]:
            stacked = np.stack([np.stack([frame[name] for frame in frames]) for frames in histories])
            tensor = torch.from_numpy(stacked).to(network.device, non_blocking=True)
            # (B, T, H, W, 3) uint8 -> (B, T, 3, H, W) in [0, 1]
            inputs[name] = tensor.movedim(-1, 2).float() / 255 if name in network.images else tensor
        with torch.inference_mode(), noise_of(rows):
            actions = network.module.predict_action(inputs)["action"]
        return [Prediction(chunk) for chunk in actions.float().cpu().numpy()]

    def _parts(self, network: DiffusionNetwork) -> list[str]:
        usual = ["state" if name == OBS else name for name in network.vectors]
        return usual if self.config.state is None else self.config.state

    def _cameras(self, network: DiffusionNetwork) -> dict[str, str]:
        usual = {name: ours for name, ours in USUAL_CAMERAS.items() if name in network.images}
        return choose_cameras(self.config.cameras, usual, list(network.images))


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Scale an image, and crop its centre to the model's aspect ratio, as the authors' get_real_obs_dict does."""
    if image.shape[:2] == (height, width):
        return image.copy()
    transform = require("diffusion_policy.common.cv2_util").get_image_transform
    return np.ascontiguousarray(transform(image.shape[1::-1], (width, height))(image))


def _action(dim: int, *, absolute: bool) -> ActionSpec:
    """Describe the actions; those of `abs_action` are one or two poses in the base frame, with 6D rotations."""
    if not absolute or dim % _POSE_NUMBERS:
        return ActionSpec(dim=dim)
    return ActionSpec(dim=dim, space="ee_pose", delta=False, rotation="rot6d", frame="base")
