"""RoboArena's clients: openpi's, with a configuration at the start and an `endpoint` in each request."""

from __future__ import annotations

from typing import Any

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.serve.dialects.config import RoboArena
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.openpi import MapDoor, Talk
from vlagents_ray.wire.messages import NAME_CHARACTERS, Reply


class RoboArenaDoor(MapDoor):
    """Its episodes end with `reset`, or with another `session_id`."""

    def __init__(self, dialect: RoboArena, house: House) -> None:
        super().__init__("roboarena", dialect, house)
        self._first = dialect.first()
        self._bare = dialect.bare

    def first(self) -> dict[str, Any]:
        return self._first

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" in message

    def begins(self, message: dict[str, Any], talk: Talk) -> str | None:
        endpoint = message.get("endpoint", "infer")
        if not isinstance(endpoint, str) or endpoint not in ("infer", "reset"):
            raise MalformedMessage(f"endpoint: got {str(endpoint)[:40]!r}, want 'infer' or 'reset'")
        if endpoint == "reset":
            talk.conversation.begin_again()
            return "reset successful"
        if (named := message.get("session_id")) is not None:
            episode = str(named)[:NAME_CHARACTERS]  # of a text, or of an array of one
            if talk.episode not in (None, episode):
                talk.conversation.begin_again()
            talk.episode = episode
        return None

    def answer(self, reply: Reply, before_ms: float | None) -> Any:
        return self.rows(reply) if self._bare else super().answer(reply, before_ms)
