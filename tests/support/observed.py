"""A request and its answer, as an observer sees them."""

from __future__ import annotations

from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.requests import RANKS, PendingRequest


def observe(
    observer: Observer, session: str, request: Request, reply: Reply, files: DecodedFiles | None = None
) -> None:
    pending = PendingRequest(session, request, lambda _: None, RANKS[request.rank], kept={})
    pending.files = files or {}
    observer.on_request(pending)
    request.obs = None  # as the engine does once the policy has acted
    observer.before_answer(pending, reply)
    observer.on_answer(pending, reply)
