"""Clients of vLLM-Omni's `/v1/realtime/robot/openpi`, which speak RoboArena's protocol with a few differences.

They are those of its `entrypoints/openpi/connection.py` at 72a58c4 and of its tests' clients: an action is the array
itself, a reset is answered by a map, an error is a map after which the connection stays open, a `seed` may come with an
observation, and a client that sends nothing for 30 s is disconnected. Its earliest servers answered a reset with text,
which their clients did not read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.interface import Obs
from vlagents_ray.serve.dialects.openpi import MapConnection
from vlagents_ray.serve.dialects.roboarena import RoboArenaDialect, RoboArenaDialectConfig
from vlagents_ray.wire import openpi


class VllmOmniDialectConfig(RoboArenaDialectConfig):
    """RoboArena's settings, and the idle time-out that vLLM-Omni calls `--robot-openpi-idle-timeout`."""

    bare: bool = Field(default=True, description="answer the array itself, as vLLM-Omni's clients want it")
    idle_s: float = Field(
        default=30.0, ge=0, description="a client that sends nothing for so long, s, is closed; 0: none"
    )
    metadata: dict[str, Any] = Field(
        default_factory=dict, description="added to what the client is sent first, such as action_horizon"
    )

    def first(self) -> dict[str, Any]:
        """Return the fields of PolicyServerConfig, and those that the deployment adds."""
        return {
            key: value for key, value in super().first().items() if key not in ("idle_s", "metadata")
        } | self.metadata


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
