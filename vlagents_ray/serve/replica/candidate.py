"""The Serve deployment of a candidate, which acts beside the live policy; no client reaches it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ray
from ray import serve

from vlagents_ray.contract import Contract
from vlagents_ray.protocol.frames import decode_replies
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects.gateway import wait_for_policy
from vlagents_ray.serve.replica.engine_replica import EngineReplica
from vlagents_ray.serve.replica.metrics import ShadowExporter, tags_of
from vlagents_ray.serve.shadow.comparison import Comparer, ComparisonLog, require_comparable


class CandidateReplica(EngineReplica):
    """Acts on what a live policy has acted on, and compares. It loads once the live policy can act."""

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, args: dict[str, Any], record: str | None, record_mb: int
    ) -> None:
        """Create the replica of the candidate.

        Args:
            args: Its settings.
            record: The folder of the comparisons; None records none.
            record_mb: Most MB of them.
        """
        self._live: Contract | None = None
        self._open_engine(ServerArgs(**args), self._check)
        context = serve.get_replica_context()
        log = None
        if record is not None:
            log = await asyncio.to_thread(
                ComparisonLog, Path(record), context.app_name, context.replica_tag, record_mb * 10**6
            )
        self._comparer = Comparer(log)
        self._metrics = ShadowExporter(self._comparer, tags_of(self._args.policy))

    def _check(self, contract: Contract | None) -> None:
        require_comparable(self._live, contract)

    async def _start(self) -> None:
        self._live = await asyncio.to_thread(wait_for_policy, serve.get_replica_context().app_name)
        await super()._start()
        self._metrics.start()

    async def actor(self) -> Any:
        """Return the actor, whose `follow` a live replica calls."""
        return ray.get_runtime_context().current_actor

    async def follow(
        self, sessions: Sequence[str], frames: Sequence[Any], live: Any, dropped: Sequence[int]
    ) -> list[str]:
        """Act on requests of different sessions as the live policy did, and compare.

        Args:
            sessions: The session of each request, as the live engine names it.
            frames: A frame of each request.
            live: One frame of the live policy's replies.
            dropped: See `Comparer.add`.

        Returns:
            The sessions that are unknown here, and cannot be followed before their next reset.
        """
        found = await asyncio.gather(*map(self._act, sessions, frames))
        asked, replies = [request for request, _ in found], [reply for _, reply in found]
        return await asyncio.to_thread(self._comparer.add, asked, decode_replies(memoryview(live)), replies, dropped)

    async def _act(self, session: str, frame: Any) -> tuple[Request, Reply]:
        requests, message = await self._ask(session, frame)
        request = requests[0] if requests else Request("reset", session=session)  # unreadable: the episode is lost
        return request, message.replies[0]

    async def __del__(self) -> None:
        if hasattr(self, "_metrics"):
            await asyncio.to_thread(self._engine.close)
            await asyncio.to_thread(self._metrics.close)
