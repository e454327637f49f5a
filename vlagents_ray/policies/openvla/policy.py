"""OpenVLA: a picture and an instruction in, the next action out, token by token."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from vlagents_ray.contract import Contract
from vlagents_ray.interface import Obs
from vlagents_ray.policies.base import Row
from vlagents_ray.policies.base.observing import camera_images, camera_specs, choose_cameras
from vlagents_ray.policies.openvla import pictures
from vlagents_ray.policies.openvla.decoding import decode
from vlagents_ray.policies.openvla.family import Answer, Asked, PrismaticConfig, PrismaticPolicy
from vlagents_ray.policies.openvla.prismatic import Prismatic, load_prismatic

_IMAGE = "image"  # the model's only camera


class OpenVLAConfig(PrismaticConfig):
    """Settings of OpenVLA."""

    center_crop: bool = Field(
        default=False,
        description="for checkpoints trained with random crops, such as LIBERO's: pictures go through JPEG and Lanczos "
        "to 224 px, and the middle nine tenths of them to the model; else the checkpoint's own resizing is all",
    )


class OpenVLA(PrismaticPolicy):
    """One action an `act`."""

    Config = OpenVLAConfig
    config: OpenVLAConfig
    model: Prismatic

    def __init__(self, config: OpenVLAConfig) -> None:
        super().__init__(config)
        self._cameras = choose_cameras(config.cameras, {_IMAGE: "front"}, [_IMAGE])

    @property
    def contract(self) -> Contract:
        """One camera and an instruction; the action of the checkpoint's datasets."""
        return Contract(
            cameras=camera_specs(self._cameras),
            state={},
            instruction=True,
            action=self._action(),
            chunk=self.chunk(1),
            history=1,
        )

    def load(self) -> Prismatic:
        """Read the checkpoint."""
        return load_prismatic(self.config)

    def perceive(self, obs: Obs) -> Any:
        """The picture as the backbones want it, (C, S, S) float32."""
        image = camera_images(obs, self._cameras)[_IMAGE]
        if self.config.center_crop:
            image = pictures.middle(pictures.resized(image))
        return self.model.pixels(image)

    @property
    def _checkpoint(self) -> Prismatic | None:
        return self.model

    def _question(self, row: Row, key: str) -> tuple[Any, list[int]]:
        return row.frames[-1], self.model.tokens(row.instruction)

    def _answer(self, asked: Sequence[Asked]) -> list[Answer]:
        """One decode; a session's own answer is greedy, samples are drawn at temperature 1 and share its prompt."""
        prompts = {_prompt(ask): ask.question for ask in asked}
        places = {prompt: place for place, prompt in enumerate(prompts)}
        draws = np.full((len(asked), max(ask.scale.dim for ask in asked)), np.nan)
        for numbers, ask in zip(draws, asked, strict=True):
            if ask.row.sample:
                numbers[: ask.scale.dim] = ask.row.rng.random(ask.scale.dim)
        answers = decode(self.model, list(prompts.values()), [places[_prompt(ask)] for ask in asked], draws)
        return [
            Answer(*(part[None, : ask.scale.dim] for part in parts))
            for ask, *parts in zip(asked, *answers, strict=True)
        ]


def _prompt(ask: Asked) -> tuple[int, str]:
    """The same for a session's own row and its samples."""
    return id(ask.row.frames), ask.row.instruction
