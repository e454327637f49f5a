"""The reference policy, which uses the network of this package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import GIVEN, Obs
from vlagents_ray.policies.base import (
    AdapterConfig,
    ModelPolicy,
    Prediction,
    Row,
    model_inputs,
    shared_frames,
)
from vlagents_ray.policies.base.accelerator import torch_device, torch_dtype
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.base.config import Guidance, NoiseLevel
from vlagents_ray.policies.base.staging import StagedRow, Staging
from vlagents_ray.policies.flow import OFFERED, FlowPasses
from vlagents_ray.policies.reference.checkpoint import (
    CAMERAS,
    CONFIG,
    WEIGHTS,
    Checkpoint,
    Embodiment,
    NetworkSizes,
    normalised,
    pixels,
    read_checkpoint,
)
from vlagents_ray.registry import require


class ReferencePasses(FlowPasses):
    """The forward passes of a `ReferenceNetwork`. Actions stay in float32 between the steps."""

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        return self.model.encode(tokens, state, *images), tokens

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        encoded, _, _ = constants
        return self.model.velocity(encoded, actions.to(encoded.dtype), times).float()

    def with_prefixes(self, encoded: Any, actions: Any, frozen: Any) -> Any:
        return self.model.with_prefixes(encoded, actions, frozen)


class ReferenceConfig(AdapterConfig):
    """Settings of the reference policy, in addition to those of all models."""

    embodiment: str | None = Field(
        default=None,
        description="the robot, as the checkpoint names it; unset: the only one that it has",
    )
    steps: int = Field(default=5, ge=1, description="steps of the flow")
    initial_noise: float = Field(
        default=1.0,
        ge=0,
        le=1,
        description="standard deviation of the noise from which the flow begins; 1: as in "
        "training; 0: equal observations have equal chunks, and the chunks of successive "
        "observations agree, which helps if answers are late",
    )
    guidance: Guidance = 5.0
    noise_level: NoiseLevel = 0.0


@dataclass(frozen=True)
class LoadedReference:
    """The network, and the metadata of its checkpoint."""

    network: Any
    checkpoint: Checkpoint
    robot: Embodiment
    cameras: dict[str, str]  # name in CAMERAS, in the same order -> name of the robot's camera
    dtype: Any
    passes: ReferencePasses
    staging: Staging


class Reference(ModelPolicy):
    """The reference policy, which computes chunks with flow matching.

    All sessions of a batch share one forward pass.
    """

    Config: ClassVar[type] = ReferenceConfig
    trainable = network = "model.network"
    config: ReferenceConfig
    model: LoadedReference | None

    @property
    def contract(self) -> Contract:
        """The cameras, the state and the actions of the robot, once the checkpoint is loaded."""
        if self.model is None:
            return Contract(instruction=True, history=1)

        model = self.model
        behaviour = self.offered(OFFERED if self.config.noise_level else ())
        action = ActionSpec(**model.robot.action)
        horizon = model.checkpoint.sizes.horizon
        return self.make_contract(
            model.cameras, self.state, horizon, action=action, behaviour=behaviour
        )

    @property
    def state_dim(self) -> int | None:
        return None if self.model is None else len(self.model.robot.state_mean)

    @property
    def state(self) -> list[str]:
        """The parts of the robot's proprioception, in the order of its state vector."""
        return self.config.state or self.loaded().robot.state

    @property
    def continues_plans(self) -> bool:
        """Whether a chunk continues the executed plan, which requires `actions: chunk`."""
        return self.config.actions == "chunk"

    @property
    def longest_prefix(self) -> int:
        """The largest number of rows of the executed plan with which a chunk begins; 0 if the
        checkpoint was not trained with such prefixes, in which case chunks are guided.
        """
        if self.model is None or not self.continues_plans:
            return 0
        return int(self.model.checkpoint.sizes.longest_prefix)

    def load(self) -> LoadedReference:
        """Read the checkpoint, choose its embodiment, and move the network to the device."""
        folder = find_checkpoint(
            self.config.checkpoint, self.config.checkpoint_step, needs=[CONFIG, WEIGHTS]
        )
        checkpoint = read_checkpoint(folder)
        embodiments, name = checkpoint.embodiments, self.config.embodiment
        if name is None and len(embodiments) == 1:
            [name] = embodiments
        if name is None or name not in embodiments:
            raise ConfigError(
                f"embodiment: expected one of {sorted(embodiments)}, which {folder} has, got "
                f"{name!r}"
            )
        robot = embodiments[name]

        device = torch_device(self.config.device)
        from vlagents_ray.policies.reference.network import read_network  # imports torch

        dtype = torch_dtype(self.config.dtype, device, preferred="float32")
        network = read_network(checkpoint.sizes, folder)
        network = network.eval().requires_grad_(False).to(device, dtype)
        passes = ReferencePasses(network, self.compilation)
        passes.has_prefixes = checkpoint.sizes.longest_prefix > 0
        cameras = model_inputs.choose_cameras(self.config.cameras, robot.cameras, CAMERAS)
        return LoadedReference(network, checkpoint, robot, cameras, dtype, passes, Staging(device))

    def _begin(self, instruction: str, seed: int) -> None:
        super()._begin(instruction, seed)
        if self.model is not None:
            self._current_episode().prompt = self.model.checkpoint.tokens(instruction)

    def _example(self, seed: int, instruction: str = "") -> Row:
        return super()._example(seed, instruction or self.loaded().checkpoint.words[0])

    def perceive(self, obs: Obs) -> StagedRow:
        """Return the network's inputs for one row."""
        model = self.loaded()
        sizes = model.checkpoint.sizes
        images = model_inputs.camera_images(obs, model.cameras)
        resized = [
            model_inputs.resize_with_pad(images[name], sizes.side, sizes.side) for name in CAMERAS
        ]
        state = model_inputs.state_vector(obs, self.state, self.state_dim)
        staged: StagedRow = model.staging.stage(
            {
                "tokens": self._current_episode().prompt,
                "images": np.stack(resized),
                "state": normalised(model.robot, state, sizes.state),
            }
        )
        return staged

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute one chunk for each row.

        The samples of a session share the session's encoded observation.
        """
        model, torch = self.loaded(), require("torch")
        firsts, owners = shared_frames(rows)
        sizes = model.checkpoint.sizes
        prefixes = [0] * len(rows)
        if self.longest_prefix:
            prefixes = [self._prefix(row) for row in rows]
            rows = [
                replace(row, delay=length, leftover=row.leftover if length else None)
                for row, length in zip(rows, prefixes, strict=True)
            ]
        with torch.inference_mode():
            inputs = self._inputs([rows[i] for i in firsts])
            tokens = inputs["tokens"]
            present = torch.ones(len(tokens), dtype=torch.bool, device=tokens.device)
            cameras = [present] * len(CAMERAS)
            flows, outputs = model.passes.chunks(
                rows,
                [inputs["images"].unbind(1), cameras, tokens, tokens != 0, inputs["state"]],
                owners,
                noise=np.stack([self._initial_noise(row, sizes) for row in rows]),
                steps=self.config.steps,
                config=self.config,
                dim=sizes.action,
                convert=model.staging.upload,
            )
        predictions = []
        for i, (flow, length) in enumerate(zip(flows, prefixes, strict=True)):
            info = {GIVEN: length} if length else {}
            predictions.append(Prediction(flow, behaviour=outputs.get(i, {}), info=info))
        return predictions

    def _initial_noise(self, row: Row, sizes: NetworkSizes) -> np.ndarray:
        """Return the noise from which the flow of a row begins, (H, D) float32.

        The further samples of an observation have the noise of the training, since they show how
        far the policy's plans differ.
        """
        noise = row.noise(sizes.horizon, sizes.action)
        return noise if row.sample else np.float32(self.config.initial_noise) * noise

    def _prefix(self, row: Row) -> int:
        """Return the number of rows of the executed plan with which a row's chunk begins."""
        plan = () if row.leftover is None else row.leftover
        return min(row.delay, len(plan), self.longest_prefix)

    def _inputs(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Stack the last frames of rows, converted to the dtype of the network."""
        model = self.loaded()
        inputs = model.staging.stack([row.frames[-1] for row in rows])
        images, state = pixels(inputs["images"]).to(model.dtype), inputs["state"].to(model.dtype)
        return {"tokens": inputs["tokens"], "images": images, "state": state}
