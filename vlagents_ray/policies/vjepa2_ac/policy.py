"""The policy of V-JEPA 2-AC, which plans to a goal image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import GOAL_IMAGE, Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.accelerator import torch_device, torch_dtype
from vlagents_ray.policies.base.model_inputs import (
    GRIPPER,
    camera_images,
    camera_specs,
    choose_cameras,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.vjepa2_ac.network import (
    Encoder,
    VJepa2AcConfig,
    load_encoder,
    load_predictor,
    normalizer,
    read_checkpoint,
    to_pixels,
    usual_attention,
)
from vlagents_ray.policies.vjepa2_ac.planner import DRAWN, Tensor, plan
from vlagents_ray.registry import require

CAMERA = "front"  # the model has one camera, without a name
_STATE = ["xyzrpy"]
_GOAL, _GOAL_FEATURES = "goal", "goal_features"  # keys in a session's memory: pixels, and their features


@dataclass(frozen=True, slots=True)
class Frame:
    """The parts of an observation that the session keeps."""

    pixels: np.ndarray  # (3, side, side) float32
    pose: np.ndarray  # (7,) float32: x, y, z m, roll, pitch, yaw rad, closedness


class WorldModel:
    """The encoder and the predictor; weights and features are float32, computations may be in another type."""

    def __init__(
        self, encoder: Any, predictor: Any, config: VJepa2AcConfig, dtype: Any, compilation: Compilation
    ) -> None:
        self.encode = Encoder(encoder, config.normalize, compilation)
        self._predictor = predictor
        self._following = [  # by the number of frames that are known
            compilation.core(f"predict frame {frames + 1}", self._predict, config.plans_a_pass)
            for frames in range(1, config.rollout + 1)
        ]
        self._normalized = normalizer(config.normalize)
        self._device, self._dtype = encoder.device.type, dtype

    def autocast(self) -> Any:
        """Return a context that computes in `dtype`, as upstream trains; its attention needs weights of one type."""
        torch = require("torch")
        return torch.autocast(self._device, self._dtype, enabled=self._dtype != torch.float32)

    def __call__(self, features: Tensor, actions: Tensor, poses: Tensor) -> Tensor:
        """Predict the next frame's features (see `planner.World`)."""
        return self._following[features.shape[1] - 1](features, actions, poses)

    def _predict(self, features: Tensor, actions: Tensor, poses: Tensor) -> Tensor:
        tokens = features.shape[2]
        return self._normalized(self._predictor(features.flatten(1, 2), actions, poses)[:, -tokens:].float())


class VJepa2Ac(ModelPolicy):
    """Moves the gripper so that the camera's image becomes `info["goal_image"]`.

    The goal image is in the `reset`'s observation or any later one, and holds until there is another one.
    """

    Config: ClassVar[type] = VJepa2AcConfig
    config: VJepa2AcConfig

    def __init__(self, config: VJepa2AcConfig) -> None:
        super().__init__(config)
        self._cameras = choose_cameras(config.cameras, {CAMERA: "front"}, [CAMERA])
        self._state = config.state or _STATE

    @property
    def contract(self) -> Contract:
        return Contract(
            cameras=camera_specs(self._cameras),
            state=state_specs(self._state, 6),
            gripper=True,
            action=ActionSpec(
                dim=7,
                space="ee_pose",
                delta=True,
                rotation="euler_xyz",
                frame="base",
                gripper_open=1.0,
                gripper_closed=0.0,
            ),
            chunk=self.chunk(self.config.rollout),
        )

    def load(self) -> WorldModel:
        """Load encoder and predictor, with every parameter from the checkpoint."""
        saved = read_checkpoint(self.config)
        device = torch_device(self.config.device)
        dtype = torch_dtype(self.config.dtype, device, preferred="float32")  # upstream plans in float32
        encoder = load_encoder(self.config, saved.get("encoder"))
        predictor = load_predictor(self.config, saved["predictor"], encoder.config.hidden_size)
        return WorldModel(encoder.to(device).eval(), predictor.to(device).eval(), self.config, dtype, self.compilation)

    def notice(self, obs: Obs) -> None:
        """Set the goal to that of an observation, if it has one; features of the same image are kept."""
        image = obs.info.get(GOAL_IMAGE)
        if image is None:
            return
        if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            got = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
            raise InvalidObservation(f"info[{GOAL_IMAGE!r}]: got {got}, want (H, W, 3) uint8 RGB")
        goal, memory = to_pixels(image, self.config.image_size), self._begun().memory
        if _GOAL not in memory or not np.array_equal(goal, memory[_GOAL]):
            memory[_GOAL] = goal
            memory.pop(_GOAL_FEATURES, None)

    def perceive(self, obs: Obs) -> Frame:
        pose = state_vector(obs, [*self._state, GRIPPER], 7)
        pose[6] = 1 - pose[6]
        [image] = camera_images(obs, self._cameras).values()
        return Frame(to_pixels(image, self.config.image_size), pose)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        ready = [row for row in rows if _GOAL in row.memory]
        found = iter(self._plans(ready) if ready else [])
        no_goal = InvalidObservation(
            f"info[{GOAL_IMAGE!r}]: got none since the reset, want an image of the goal, (H, W, 3) uint8"
        )
        return [next(found) if _GOAL in row.memory else no_goal for row in rows]

    def _plans(self, rows: Sequence[Row]) -> list[Prediction]:
        torch = require("torch")
        config, world = self.config, self.model
        new = [row for row in rows if _GOAL_FEATURES not in row.memory]
        shape = (config.iterations, config.rollout, config.samples, DRAWN)
        with torch.inference_mode(), world.autocast(), usual_attention():
            features = world.encode([row.frames[-1].pixels for row in rows])
            goals_of_new = world.encode([row.memory[_GOAL] for row in new]) if new else []
            for row, goal in zip(new, goals_of_new, strict=True):
                row.memory[_GOAL_FEATURES] = goal.clone()
            poses, noise = (
                torch.as_tensor(np.stack(parts)).to(features.device, non_blocking=True)
                for parts in ([row.frames[-1].pose for row in rows], [row.noise(*shape) for row in rows])
            )
            goals = torch.stack([row.memory[_GOAL_FEATURES] for row in rows])
            plans = plan(world, features, poses, goals, noise, config)
        actions, std, energy = (part.cpu().numpy() for part in (plans.actions, plans.std, plans.energy))
        predictions = []
        for i, row in enumerate(rows):
            steps = _openings(actions[i], row.frames[-1].pose[6])
            predictions.append(Prediction(steps, mean=steps, std=std[i], info={"energy": float(energy[i])}))
        return predictions

    def _example(self, seed: int, instruction: str = "warm up") -> Row:
        example = super()._example(seed, instruction)
        return replace(example, memory={_GOAL: example.frames[-1].pixels})


def _openings(actions: np.ndarray, closedness: float) -> np.ndarray:
    """Replace the last column of plans (H, 7), the change of the gripper, by its opening after each step."""
    opened = actions.copy()
    for row in opened:
        closedness = float(np.clip(closedness + row[6], 0, 1))
        row[6] = 1 - closedness
    return opened
