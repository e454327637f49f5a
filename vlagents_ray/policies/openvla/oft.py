"""OpenVLA-OFT: computes a chunk of actions from images, proprioception and an instruction in one forward pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import Row, shared_frames
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    camera_specs,
    choose_cameras,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.openvla.base import OFFERED, DecodedChunk, PreparedRow, PrismaticPolicy, middle, resized
from vlagents_ray.policies.openvla.parallel import (
    Film,
    Mlp,
    ModelInput,
    Parallel,
    Projector,
    read_component,
    require_unused,
)
from vlagents_ray.policies.openvla.prismatic import Prismatic, PrismaticConfig, load_prismatic
from vlagents_ray.policies.openvla.statistics import Bounds, Statistics

_PRIMARY = "full_image"
_CAMERAS = (_PRIMARY, "wrist_image", "left_wrist_image", "right_wrist_image")  # in their order in training
_USUAL = {_PRIMARY: "front", "wrist_image": "wrist"}  # of LIBERO
_STATE = ("xyz_axis_angle", "gripper_qpos")  # of LIBERO, 6 and 2 numbers


class OpenVLAOFTConfig(PrismaticConfig):
    """Settings of OpenVLA-OFT; they must state how a checkpoint was trained, as its files do not."""

    attention: Literal["sdpa", "eager"] = Field(default="sdpa", description="of the language model; has no causal mask")
    center_crop: bool = Field(default=True, description="trained with random crops (upstream's `image_aug`)")
    head: Literal["l1", "diffusion", "tokens"] = Field(
        default="l1", description="how actions come out: by regression, by diffusion, or as tokens of bins"
    )
    film: bool = Field(default=False, description="trained with FiLM (OFT+)")
    horizon: int = Field(default=8, ge=1, description="rows of a chunk, as in training: LIBERO 8, ALOHA 25, Bridge 5")
    bounds: Bounds = Field(
        default="q99", description="of actions and states in training: 'q99', or 'min_max' for ALOHA's absolute joints"
    )
    diffusion_steps: int = Field(default=50, ge=1, description="of training")
    inference_steps: int = Field(default=50, ge=1, description="of diffusion, at most as many as in training")

    @model_validator(mode="after")
    def _steps_fit(self) -> Self:
        if self.inference_steps > self.diffusion_steps:
            raise ValueError(f"inference_steps: got {self.inference_steps}, want at most {self.diffusion_steps}")
        return self


class OpenVLAOFT(PrismaticPolicy):
    """The policy, which returns a chunk for each `act`."""

    Config = OpenVLAOFTConfig
    config: OpenVLAOFTConfig
    model: Parallel

    def __init__(self, config: OpenVLAOFTConfig) -> None:
        super().__init__(config)
        chosen = config.cameras or _USUAL
        known = [name for name in _CAMERAS if name in chosen or name == _PRIMARY]
        mapping = choose_cameras(config.cameras, _USUAL, known)
        self._cameras = {name: mapping[name] for name in known}
        self._state = list(_STATE if config.state is None else config.state)

    @property
    def contract(self) -> Contract:
        """The cameras and states of training, an instruction, and chunks of the actions of the checkpoint's
        datasets.
        """
        return Contract(
            cameras=camera_specs(self._cameras),
            state=state_specs(self._state, self.state_dim),
            gripper=needs_gripper(self._state) or None,
            instruction=True,
            action=self._action(),
            chunk=self.chunk(self.config.horizon),
            history=1,
            behaviour=self.offered(OFFERED if self.config.head == "tokens" else ()),
        )

    @property
    def state_dim(self) -> int | None:
        """The length of the state vector, which is the projector's; None if there is none, or before it is loaded."""
        return None if self.model is None or self.model.proprio is None else self.model.proprio.dim

    def load(self) -> Parallel:
        """Read the checkpoint and its components; raises `ConfigError` for a missing one, and for an unused one."""
        config = self.config
        base = load_prismatic(config, config.bounds)
        place = {"device": base.device, "dtype": base.dtype}
        parts = {
            "action_head": config.head != "tokens",
            "proprio_projector": bool(self._state),
            "noisy_action_projector": config.head == "diffusion",
            "vision_backbone": config.film,
        }
        require_unused(base.path, [name for name, used in parts.items() if not used])
        saved = {name: read_component(base.path, name) for name, used in parts.items() if used}
        prefix = "noise_predictor.mlp_resnet" if config.head == "diffusion" else "model"
        head = Mlp(saved["action_head"], prefix).to(**place) if "action_head" in saved else None
        projectors = {
            name: Projector(saved[name], name).to(**place) if name in saved else None
            for name in ("proprio_projector", "noisy_action_projector")
        }
        parallel = Parallel(
            base,
            horizon=config.horizon,
            dim=_action_dim(base.statistics, config.unnorm_key, head),
            head=head,
            proprio=projectors["proprio_projector"],
            noisy=projectors["noisy_action_projector"],
            film=Film(saved["vision_backbone"], base.network.vision_backbone).to(**place) if config.film else None,
            steps=(config.diffusion_steps, config.inference_steps),
        )
        parallel.compile_with(self.compilation)
        return parallel

    def perceive(self, obs: Obs) -> tuple[tuple[Any, ...], np.ndarray | None]:
        """Return the images as inputs of the backbones, (C, S, S) float32 each, and the state vector (P,)."""
        seen = [resized(image) for image in camera_images(obs, self._cameras).values()]
        if self.config.center_crop:
            seen = [middle(image) for image in seen]
        projector = self.model.proprio
        state = None if projector is None else state_vector(obs, self._state, projector.dim)
        return tuple(self.model.base.pixels(image) for image in seen), state

    @property
    def _checkpoint(self) -> Prismatic | None:
        return None if self.model is None else self.model.base

    def _model_input(self, row: Row, key: str) -> ModelInput:
        seen, state = row.frames[-1]
        base = self.model.base
        if (dim := base.statistics.scale(key).dim) != self.model.dim:
            raise InvalidObservation(
                f"unnorm_key: got {key!r} of {dim} numbers, want one of {self.model.dim}, the head's"
            )
        proprio = None if state is None else base.statistics.scale(key, "proprio").normalise(state)
        return ModelInput(seen, base.tokens(row.instruction), proprio)

    def _compute(self, prepared: Sequence[PreparedRow]) -> list[DecodedChunk]:
        """Run one forward pass, or one for each diffusion step. Regression has one answer, also for all samples."""
        firsts, owners = shared_frames([entry.row for entry in prepared])
        inputs = [prepared[i].model_input for i in firsts]
        shape = (self.model.horizon, self.model.dim)
        if self.config.head == "l1":
            answers = self.model.regress(inputs)
            return [DecodedChunk(answers[owner]) for owner in owners]
        if self.config.head == "diffusion":
            noise = np.stack([entry.row.noise(*shape) for entry in prepared])
            return [DecodedChunk(chunk) for chunk in self.model.denoise(inputs, owners, noise)]
        draws = np.stack(
            [entry.row.rng.random(shape) if entry.row.sample else np.full(shape, np.nan) for entry in prepared]
        )
        return self._decoded(self.model.base.bins, prepared, *self.model.choose(inputs, owners, draws))


def _action_dim(statistics: Statistics, unnorm_key: str | None, head: Mlp | None) -> int:
    """Return the length of an action, which the head and all datasets that an episode may name must share."""
    dims = statistics.action_dims(unnorm_key)
    if head is not None:
        dims.add(head.dim)
    if len(dims) != 1:
        raise ConfigError(
            f"actions: the checkpoint's head and statistics have {sorted(dims)} numbers a row, want one length; set "
            f"unnorm_key to the dataset that the head was trained on"
        )
    return dims.pop()
