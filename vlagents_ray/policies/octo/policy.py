"""Octo, with windows of real frames, tasks in words or as images, and the noise of each session."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import GOAL_IMAGE, Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.model_inputs import (
    camera_images,
    camera_specs,
    choose_cameras,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.octo.config import OctoConfig
from vlagents_ray.policies.octo.images import resized
from vlagents_ray.policies.octo.network import PROPRIO, OctoNetwork, normalised_state, real_actions

PRIMARY = "image_primary"  # the camera of goal images, which training crops
USUAL_CAMERAS = {PRIMARY: "front", "image_wrist": "wrist"}


class Octo(ModelPolicy):
    """The policy of an Octo checkpoint: a row for each session, with its window of frames and its noise."""

    Config: ClassVar[type] = OctoConfig

    def __init__(self, config: OctoConfig) -> None:
        super().__init__(config)
        self.config: OctoConfig = config

    @property
    def history(self) -> int:
        network: OctoNetwork | None = self.model
        return self.config.window or (1 if network is None else network.window)

    @property
    def contract(self) -> Contract:
        """The contract; cameras, state and the action's size are stated once the checkpoint is loaded."""
        instruction = {"language": True, "image": False}.get(self.config.goal)
        network: OctoNetwork | None = self.model
        if network is None:
            return Contract(instruction=instruction, history=self.config.window)
        dim = len(network.statistics(self.config.dataset, "action")["mean"])
        return Contract(
            cameras=camera_specs(self._cameras(network)),
            state=state_specs(self.config.state or (), self.state_dim),
            gripper=needs_gripper(self.config.state or ()),
            instruction=instruction,
            action=_action(dim, self.config.dataset),
            chunk=self.chunk(network.head.action_horizon),
            history=self.history,
        )

    @property
    def state_dim(self) -> int | None:
        """The length of the state vector; None if the checkpoint reads none, or is not loaded."""
        return None if self.model is None else self.model.proprio_dim

    def load(self) -> OctoNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        config = self.config
        network = OctoNetwork.load(config)
        self._cameras(network)
        wanted = ("mean", "std") if config.normalization == "normal" else ("mean", "p01", "p99")
        statistics = network.statistics(config.dataset, "action")
        if absent := [name for name in wanted if name not in statistics]:
            raise ConfigError(
                f"normalization {config.normalization!r}: the statistics of {config.dataset!r} have "
                f"{sorted(statistics)}, not {absent}; set it as in training"
            )
        if config.window is not None and config.window > network.longest:
            raise ConfigError(f"window: got {config.window}, want at most {network.longest}; trained: {network.window}")
        if (network.proprio_dim is None) != (not config.state):
            need = (
                "reads no state" if network.proprio_dim is None else f"reads a state of {network.proprio_dim} numbers"
            )
            raise ConfigError(f"state: got {config.state}, but the checkpoint {need}; set it as in training")
        if network.proprio_dim is not None:
            network.statistics(config.dataset, PROPRIO)
        return network

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, whose task is `obs.info["goal_image"]` if there is one, else the instruction."""
        goal = self._goal(obs, instruction)
        info = super().reset(obs, instruction, **kwargs)
        if goal is not None:
            self._begun().memory[GOAL_IMAGE] = goal
        return info

    def perceive(self, obs: Obs) -> dict[str, np.ndarray]:
        """Return the images and the state by Octo's names, in the sizes of its training."""
        network: OctoNetwork = self.model
        seen = {name: self._image(name, image) for name, image in camera_images(obs, self._cameras(network)).items()}
        if network.proprio_dim is not None:
            vector = state_vector(obs, self.config.state or (), network.proprio_dim)
            seen[PROPRIO] = normalised_state(vector, network.statistics(self.config.dataset, PROPRIO))
        return seen

    def predict(self, rows: Sequence[Row]) -> list[Prediction]:
        """Compute the chunks, with one pass of the transformer for each window and of the action head for each row."""
        network: OctoNetwork = self.model
        windows = {id(row.frames): row for row in rows}  # the samples of a session share its window
        place = {window: i for i, window in enumerate(windows)}
        asked = list(windows.values())
        size = next((size for size in self.config.batch_sizes or () if size >= len(asked)), len(asked))
        asked += asked[-1:] * (size - len(asked))
        tokens, mask = network.encode(self._observations(asked), self._tasks(asked))

        owners = [place[id(row.frames)] for row in rows]
        keys = np.stack([row.rng.integers(2**32, size=2, dtype=np.uint32) for row in rows])
        statistics = network.statistics(self.config.dataset, "action")
        actions = network.decode(tokens[owners], mask[owners], keys, len(statistics["mean"]))
        return [Prediction(real_actions(chunk, statistics, self.config.normalization)) for chunk in actions]

    def _observations(self, rows: Sequence[Row]) -> dict[str, np.ndarray]:
        """Return windows (B, W, ...), padded by the first frame, which is masked there."""
        length = self.history
        histories = [row.history(length) for row in rows]
        observations = {
            name: np.stack([np.stack([frame[name] for frame in frames]) for frames in histories])
            for name in histories[0][0]
        }
        real = [min(len(row.frames), length) for row in rows]
        observations["timestep_pad_mask"] = np.arange(length) >= length - np.array(real)[:, None]
        return observations

    def _tasks(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the tasks of a batch: words with blank goal images, or goal images with blank words, with masks."""
        goals = [row.memory.get(GOAL_IMAGE) for row in rows]
        words = [row.instruction if goal is None else "" for row, goal in zip(rows, goals, strict=True)]
        tasks: dict[str, Any] = self.model.model.create_tasks(texts=words)
        for i, goal in enumerate(goals):
            if goal is not None:
                tasks[PRIMARY][i] = goal
                tasks["pad_mask_dict"][PRIMARY][i] = True
                tasks["pad_mask_dict"]["language_instruction"][i] = False
        return tasks

    def _goal(self, obs: Obs, instruction: str | None) -> np.ndarray | None:
        goal, kind = obs.info.get(GOAL_IMAGE), self.config.goal
        if (goal is None and (kind == "image" or not instruction)) or (goal is not None and kind == "language"):
            wanted = {"language": "an instruction", "image": f"info[{GOAL_IMAGE!r}]"}
            raise InvalidObservation(
                f"task: got {'no goal image' if goal is None else 'a goal image'} and the instruction {instruction!r}, "
                f"want {wanted.get(kind, ' or '.join(wanted.values()))}; see the policy's `goal`"
            )
        if goal is None:
            return None
        if not isinstance(goal, np.ndarray) or goal.ndim != 3 or goal.shape[2] != 3 or goal.dtype != np.uint8:
            raise InvalidObservation(f"info[{GOAL_IMAGE!r}]: want (H, W, 3) uint8 RGB")
        return self._image(PRIMARY, goal)

    def _image(self, name: str, image: np.ndarray) -> np.ndarray:
        return resized(image, *self.model.cameras[name], crop=self.config.crop and name == PRIMARY)

    def _cameras(self, network: OctoNetwork) -> dict[str, str]:
        chosen, known = self.config.cameras, list(network.cameras)
        if chosen and set(chosen) <= set(known):
            return chosen  # Octo was trained with missing cameras, for which it has no tokens
        return choose_cameras(chosen, {name: ours for name, ours in USUAL_CAMERAS.items() if name in known}, known)


def _action(dim: int, dataset: str | None) -> ActionSpec:
    """Describe the actions of a pretraining dataset, in its standard form; fine-tuned checkpoints do not state them.

    octo/data/oxe: change of the end effector's position and of its roll, pitch and yaw, then the gripper, 1 = open.
    """
    if dataset is None or dim != 7:
        return ActionSpec(dim=dim)
    return ActionSpec(dim=dim, space="ee_pose", delta=True, rotation="euler_xyz", gripper_open=1.0, gripper_closed=0.0)
