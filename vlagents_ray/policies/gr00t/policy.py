"""The policy that runs NVIDIA's models and processors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract, StateSpec
from vlagents_ray.errors import PolicyFailed
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import ModelPolicy, Prediction, Row
from vlagents_ray.policies.base.model_inputs import (
    GRIPPER,
    camera_images,
    camera_specs,
    choose_cameras,
    needs_gripper,
    state_specs,
    state_vector,
)
from vlagents_ray.policies.gr00t.embodiment import Embodiment
from vlagents_ray.policies.gr00t.network import Gr00tConfig, Gr00tNetwork

USUAL_CAMERAS = {"image": "front", "wrist_image": "wrist"}  # of LIBERO; others have the checkpoint's names
GRIPPER_QPOS = "gripper_qpos"  # the part that a group `gripper` of several numbers is, as in LIBERO


@dataclass(frozen=True)
class SeenByGr00t:
    """An observation by the embodiment's names, and the model's inputs of it if it is all that the model reads."""

    images: dict[str, np.ndarray]  # (H, W, 3) uint8
    state: dict[str, np.ndarray]  # (D,) float32
    inputs: dict[str, Any] | None = None


class Gr00t(ModelPolicy):
    """The policy of a GR00T checkpoint, with one call of the model for many sessions."""

    Config: ClassVar[type] = Gr00tConfig
    config: Gr00tConfig
    model: Gr00tNetwork | None

    @property
    def history(self) -> int:
        return 1 if self.model is None else self.model.embodiment.history

    @property
    def state_dim(self) -> int | None:
        """The length of the embodiment's state; None before the checkpoint is loaded."""
        return None if self.model is None else sum(self.model.embodiment.state.values())

    @property
    def contract(self) -> Contract:
        """The contract of the embodiment; before the checkpoint is loaded it states only the instruction."""
        if self.model is None:
            return Contract(instruction=True)
        robot = self.model.embodiment
        parts = self._parts(robot)
        own = {part: StateSpec(width) for part, width in parts.items() if part != GRIPPER}
        return Contract(
            cameras=camera_specs(self._cameras(robot)),
            state=own if self.config.state is None else state_specs(list(parts), self.state_dim),
            gripper=needs_gripper(list(parts)),
            instruction=True,
            action=robot.spec,
            chunk=self.chunk(robot.horizon),
            history=self.history,
        )

    def load(self) -> Gr00tNetwork:
        """Read the checkpoint; raises `ConfigError` for settings that do not fit it."""
        network = Gr00tNetwork.load(self.config)
        self._cameras(network.embodiment)
        return network

    def perceive(self, obs: Obs) -> SeenByGr00t:
        """Return the images and the state by the embodiment's names, and, without a history, the model's inputs."""
        network = self._loaded()
        robot = network.embodiment
        images = {name: image.copy() for name, image in camera_images(obs, self._cameras(robot)).items()}
        vector = state_vector(obs, list(self._parts(robot)), self.state_dim)
        ends = np.cumsum([0, *robot.state.values()])
        state = {group: vector[a:b] for group, (a, b) in zip(robot.state, pairwise(ends), strict=True)}
        if self.history > 1:
            return SeenByGr00t(images, state)
        moments = (len(robot.moments["video"]), len(robot.moments["state"]))
        inputs = network.inputs([images] * moments[0], [state] * moments[1], self._begun().instruction)
        return SeenByGr00t(images, state, inputs)

    def predict(self, rows: Sequence[Row]) -> list[Prediction | Exception]:
        """Compute the chunks of all rows whose observations GR00T's processor accepts."""
        read = [self._inputs(row) for row in rows]
        places = [place for place, one in enumerate(read) if not isinstance(one, Exception)]
        found: list[Prediction | Exception] = list(read)  # type: ignore[arg-type]  # what is no error is replaced
        if places:
            chunks = self._loaded().chunks(
                [rows[place].rng for place in places],
                [read[place] for place in places],  # type: ignore[misc]
                alike=self.config.deterministic,
            )
            for place, chunk in zip(places, chunks, strict=True):
                found[place] = Prediction(chunk)
        return found

    def _inputs(self, row: Row) -> dict[str, Any] | Exception:
        """Return the model's inputs of a row, or an exception for its session."""
        newest = row.frames[-1]
        if newest.inputs is not None:
            return newest.inputs  # type: ignore[no-any-return]
        network, frames = self._loaded(), row.history(self.history)
        moments = network.embodiment.moments
        try:
            return network.inputs(
                [frames[moment - 1].images for moment in moments["video"]],
                [frames[moment - 1].state for moment in moments["state"]],
                row.instruction,
            )
        except Exception as error:  # noqa: BLE001 - returned to the session of the observation
            return error

    def _parts(self, robot: Embodiment) -> dict[str, int | None]:
        """Return the parts of the state that make up the model's, with their widths where these are known."""
        if self.config.state is not None:
            return dict.fromkeys(self.config.state)
        return {
            GRIPPER_QPOS if group == GRIPPER and width > 1 else group: width for group, width in robot.state.items()
        }

    def _cameras(self, robot: Embodiment) -> dict[str, str]:
        usual = {name: USUAL_CAMERAS.get(name, name) for name in robot.cameras}
        return choose_cameras(self.config.cameras, usual, list(robot.cameras))

    def _loaded(self) -> Gr00tNetwork:
        if self.model is None:
            raise PolicyFailed("gr00t: act before initialize; the checkpoint is not loaded")
        return self.model
