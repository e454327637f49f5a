"""RoboArena's clients, and those of vLLM-Omni's `/v1/realtime/robot/openpi`, which speak openpi's protocol.

RoboArena's server sends a configuration at the start, and each request has an `endpoint`.

vLLM-Omni's differences are those of its `entrypoints/openpi/connection.py` at 72a58c4 and of its tests' clients: an
action is the array itself, a reset is answered by a map, an error is a map after which the connection stays open, a
`seed` may come with an observation, and a client that sends nothing for 30 s is disconnected. Its earliest servers
answered a reset with text, which their clients did not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Reply
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects.openpi import MapConnection, MapDialect
from vlagents_ray.wire import openpi
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


class VllmOmniDialectConfig(RoboArenaDialectConfig):
    """RoboArena's settings, and the idle time-out that vLLM-Omni calls `--robot-openpi-idle-timeout`."""

    bare: bool = Field(default=True, description="answer the array itself, as vLLM-Omni's clients want it")
    idle_s: float = Field(
        default=30.0, ge=0, description="a client that sends nothing for so long, s, is closed; 0: none"
    )
    metadata: dict[str, Any] = Field(
        default_factory=dict, description="added to what the client is sent first, such as action_horizon"
    )


class VllmOmniDialect(RoboArenaDialect):
    """vLLM-Omni's protocol: `reset` or another `session_id` begins an episode, for which a `seed` may be sent."""

    Config = VllmOmniDialectConfig
    clients = "vLLM-Omni"
    root: ClassVar[str] = ""  # its clients name the path
    summary = (
        "A session is the connection; `reset` or a new `session_id` begins an episode. An error is a map, and the "
        "connection stays open."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /v1/realtime/robot/openpi": "stream"}
    presets: ClassVar[dict[str, dict[str, Any]]] = {}
    config: VllmOmniDialectConfig

    @property
    def idle_s(self) -> float | None:
        return self.config.idle_s or None

    def first(self) -> dict[str, Any]:
        return super().first() | self.config.metadata

    def read(self, theirs: Any) -> tuple[Obs, str | None]:
        """Return an observation and its instruction; of a stack of frames, (T, H, W, 3), it has the newest."""
        if isinstance(theirs, dict):
            theirs = {key: value[-1:] if _is_stack(value) else value for key, value in theirs.items()}
        return super().read(theirs)

    def begins(self, message: dict[str, Any], connection: MapConnection) -> bytes | str | None:
        said = super().begins(message, connection)
        return None if said is None else openpi.encode({"status": said})

    def reset_arguments(self, message: dict[str, Any]) -> dict[str, Any]:
        if (seed := message.get("seed")) is None:
            return {}
        if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
            raise MalformedMessage(f"seed: got {shown(seed)}, want an integer, 0 or more")
        return {"seed": int(seed)}

    def failure(self, text: str) -> bytes | None:
        return openpi.encode({"type": "error", "message": text})


def _is_stack(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 4 and len(value) > 0
