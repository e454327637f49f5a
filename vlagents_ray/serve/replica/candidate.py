"""The Serve deployment of a candidate, which acts beside the live policy, and the live replicas' link to it."""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray import serve

from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.protocol.frames import decode_replies, encode_replies
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects.gateway import wait_for_policy
from vlagents_ray.serve.observers.comparison import Comparer, ComparisonLog, require_comparable
from vlagents_ray.serve.observers.shadow import Turn
from vlagents_ray.serve.replica.engine_replica import ReplicaEngine
from vlagents_ray.serve.replica.metrics import ShadowExporter, tags_of


class CandidateReplica:
    """Acts on what a live policy has acted on, and compares. It loads once the live policy can act.

    No client reaches it.
    """

    _opened = False  # whether there is something to close

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, args: dict[str, Any], record: str | None, record_mb: int
    ) -> None:
        """Create the replica of the candidate; `record` is the folder of at most `record_mb` MB of comparisons."""
        settings, context = ServerArgs(**args), serve.get_replica_context()
        self._live: Contract | None = None
        self._policy = ReplicaEngine.from_args(settings, lambda contract: require_comparable(self._live, contract))
        log = None
        if record is not None:
            make = partial(ComparisonLog, Path(record), context.app_name, context.replica_tag, record_mb * 10**6)
            log = await asyncio.to_thread(make)
        self._comparer = Comparer(log)
        self._metrics = ShadowExporter(self._comparer, tags_of(settings.policy))
        self._opened = True

    async def reconfigure(self, settings: dict[str, Any] | None, rank: Any) -> None:
        """See `PolicyReplica.reconfigure`."""
        if self._policy.configure(settings):
            self._live = await asyncio.to_thread(wait_for_policy, serve.get_replica_context().app_name)
            await self._policy.load()
            self._metrics.start()

    async def check_health(self) -> None:
        """See `PolicyReplica.check_health`."""
        await self._policy.check_health()

    async def actor(self) -> Any:
        """Return the actor, whose `follow` a live replica calls."""
        return ray.get_runtime_context().current_actor

    async def follow(
        self, sessions: Sequence[str], frames: Sequence[Any], live: Any, dropped: Sequence[int]
    ) -> list[str]:
        """Act on requests of different sessions as the live policy did, and compare; see `Comparer.add`.

        A frame of each request, and one of all replies of the live policy, are read in place.

        Returns:
            The sessions that are unknown here, and cannot be followed before their next reset.
        """
        found = await asyncio.gather(*map(self._act, sessions, frames))
        asked, replies = [request for request, _ in found], [reply for _, reply in found]
        return await asyncio.to_thread(self._comparer.add, asked, decode_replies(memoryview(live)), replies, dropped)

    async def _act(self, session: str, frame: Any) -> tuple[Request, Reply]:
        requests, message = await self._policy.ask(session, frame)
        request = requests[0] if requests else Request("reset", session=session)  # unreadable: the episode is lost
        return request, message.replies[0]

    async def __del__(self) -> None:
        if self._opened:
            await asyncio.to_thread(self._policy.engine.close)
            await asyncio.to_thread(self._metrics.close)


class CandidateLink:
    """Calls the candidate's replica, which is looked up again when it is gone; see `ShadowSender`.

    Serve's own router takes longer for a call, and holds the interpreter's lock meanwhile.
    """

    def __init__(self, handle: Any) -> None:
        """`handle` is that of the candidate's deployment."""
        self._handle = handle
        self._actor: Any = None

    def __call__(self, turns: Sequence[Turn]) -> Collection[str]:
        """Send turns, and wait for the candidate without a limit: its own `limits` are those of its calls."""
        try:
            if self._actor is None:  # waits until the candidate has loaded
                self._actor = self._handle.actor.remote().result()
            frames = [pickle.PickleBuffer(turn.frame) for turn in turns]
            live = pickle.PickleBuffer(encode_replies([turn.reply for turn in turns]))
            sessions, dropped = [turn.session for turn in turns], [turn.dropped for turn in turns]
            pending = call_replica(self._actor, CandidateReplica.follow, sessions, frames, live, dropped)
            lost: Collection[str] = ray.get(pending)
        except ray.exceptions.RayError as error:
            self._actor = None
            raise PolicyUnavailable(f"shadow: {type(error).__name__}; it is looked up again") from error
        return lost
