"""RoboArena's clients, which speak openpi's protocol.

RoboArena's server sends a configuration at the start, and each request has an `endpoint`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Reply
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects.openpi import MapConnection, MapDialect
from vlagents_ray.wire.openpi import ROBOARENA


class RoboArenaDialectConfig(DialectConfig):
    """The settings of RoboArena's client; except for `bare`, the fields are those of its PolicyServerConfig."""

    mapping: MappingSetting = "roboarena"
    image_resolution: tuple[int, int] | None = Field(default=(224, 224), description="height, width; null: any")
    needs_wrist_camera: bool = True
    n_external_cameras: int = Field(default=1, ge=0, le=2)
    needs_stereo_camera: bool = False
    needs_session_id: bool = False
    action_space: Literal["joint_position", "joint_velocity", "cartesian_position", "cartesian_velocity"] = (
        "joint_position"
    )
    bare: bool = Field(default=False, description="answer the array itself, as older clients want it")


class RoboArenaDialect(MapDialect):
    """RoboArena's protocol: an episode ends with `reset`, or with another `session_id`."""

    Config = RoboArenaDialectConfig
    clients = "RoboArena"
    summary = (
        "A session is the connection; `reset` or a new `session_id` begins an episode. An error is a text, "
        "then close 1011."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /roboarena": "stream"}
    presets = ROBOARENA
    config: RoboArenaDialectConfig

    def first(self) -> dict[str, Any]:
        ours = {"mapping", "rank", "bare"}
        return self.config.model_dump(mode="json", include=RoboArenaDialectConfig.model_fields.keys() - ours)

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" in message

    def begins(self, message: dict[str, Any], connection: MapConnection) -> bytes | str | None:
        endpoint = message.get("endpoint", "infer")
        if not isinstance(endpoint, str) or endpoint not in ("infer", "reset"):
            raise MalformedMessage(f"endpoint: got {shown(endpoint)}, want 'infer' or 'reset'")
        if endpoint == "reset":
            connection.end_episodes()
            return "reset successful"
        if (named := message.get("session_id")) is not None:
            if isinstance(named, np.ndarray) and named.size == 1:  # the client sends a text, or an array with one text
                named = named.item()
            episode = shown(named, NAME_CHARACTERS)
            if connection.episode not in (None, episode):
                connection.end_episodes()
            connection.episode = episode
        return None

    def answer(self, replies: Sequence[Reply], before_ms: float | None, *, batched: bool) -> Any:
        return self.rows(replies[0]) if self.config.bare else super().answer(replies, before_ms, batched=batched)
