"""From an event loop to the batch queue and back."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from vlagents_ray.errors import DeadlineExceeded
from vlagents_ray.wire.messages import Reply, Request

if TYPE_CHECKING:
    from vlagents_ray.serve.engine import Engine
    from vlagents_ray.serve.stats import Visit


async def ask(engine: Engine, session_id: str, request: Request, visit: Visit) -> Reply:
    """Submit a request and wait for its reply, no longer than its deadline.

    A caller that stops waiting (deadline, disconnect) takes its request out of the queue, unless
    its batch is under way.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[Reply] = loop.create_future()

    def deliver(reply: Reply) -> None:  # on the policy's thread
        loop.call_soon_threadsafe(_settle, future, reply)

    ticket = engine.submit(session_id, request, deliver, visit.rank, transport=visit.transport)
    timer = None
    if request.deadline_ms is not None:
        late = DeadlineExceeded(f"no action within {request.deadline_ms:g} ms")
        reply = Reply(request.request_id, error=late)
        timer = loop.call_later(request.deadline_ms / 1e3, _settle, future, reply)
    try:
        return await future
    finally:
        ticket.cancelled = True
        if timer is not None:
            timer.cancel()


def _settle(future: asyncio.Future[Reply], reply: Reply) -> None:
    if not future.done():
        future.set_result(reply)
