"""What a policy returned, or raised, as a reply that may leave the server."""

from __future__ import annotations

import logging
from typing import Any

from vlagents_ray.contract import Contract, check_action
from vlagents_ray.errors import InvalidInput, PolicyFailed, VLAgentsError
from vlagents_ray.interface import Act
from vlagents_ray.serve.batching import Ticket
from vlagents_ray.serve.sessions import Session
from vlagents_ray.wire.messages import Reply
from vlagents_ray.wire.tree import Writer

logger = logging.getLogger(__name__)


def answer(ticket: Ticket, session: Session, result: Act | Exception, contract: Contract | None) -> Reply:
    """The reply to an act, which the session counts if it may be sent."""
    request_id = ticket.request.request_id
    try:
        if isinstance(result, Exception):
            raise result
        if not isinstance(result, Act):
            raise PolicyFailed(f"act: the policy returned {type(result).__name__}, want an Act")
        act = Act(check_action(result.action, contract), bool(result.done), result.info)
        if act.info:
            require_sendable(act.info)
    except Exception as error:  # noqa: BLE001 - becomes the reply
        return Reply(request_id, error=explain(error, ticket))
    session.steps += 1
    return Reply(request_id, act=act, step=session.steps)


def explain(error: Exception, ticket: Ticket) -> VLAgentsError:
    """The error as the caller may see it; what the policy itself raised stays in the log."""
    if isinstance(error, VLAgentsError):
        return error
    request = ticket.request
    logger.error(
        "%s failed (session %s, request %s)", request.op, ticket.session_id, request.request_id, exc_info=error
    )
    return PolicyFailed(
        f"{request.op}: the policy raised {type(error).__name__}; "
        f"the server's log has the details under request id {request.request_id or '(none)'}"
    )


def timing(arrived: float, begun: float, ended: float) -> dict[str, Any]:
    """The stages of a request that the engine knows of, ms."""
    return {"queue_ms": (begun - arrived) * 1e3, "inference_ms": (ended - begun) * 1e3}


def require_sendable(info: dict[str, Any]) -> None:
    """An answer that cannot travel fails its own session, here, and nothing later; no array is copied for it."""
    try:
        Writer().value(info)
    except InvalidInput as error:
        raise PolicyFailed(f"the policy's answer cannot be sent: {error}") from error
