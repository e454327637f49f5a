"""Builds replies from a policy's results and errors, which are checked and limited in size."""

from __future__ import annotations

import logging
import sysconfig
import traceback
from bdb import BdbQuit
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidInput, MessageTooLarge, PolicyFailed, VLAgentsError
from vlagents_ray.interface import Act
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, REPLY_BYTES, Reply
from vlagents_ray.protocol.values import ValueWriter
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.sessions import Session
from vlagents_ray.validation import check_action

logger = logging.getLogger(__name__)

# Folders of this package and of Python's library.
_LIBRARIES = (str(Path(__file__).parents[2]), sysconfig.get_path("stdlib"))


def build_reply(
    pending: PendingRequest,
    session: Session[LoadedModel],
    result: Act | Exception,
    contract: Contract | None,
    limit: int = REPLY_BYTES,
    policy: Mapping[str, Any] = MappingProxyType({}),
) -> Reply:
    """Build the reply to an act request, and count the step of its session if the result is valid.

    Args:
        result: The policy's result, or the error that it raised.
        contract: The policy's contract, with which the action is compared; None if it has none.
        limit: Maximum size of action and info together, bytes.
        policy: Version of the weights that computed the action, which is added to the info unless
            the policy itself returns a version (as a proxy does).

    Returns:
        The reply. It contains an error if the policy raised an error, or if the policy's result is
        invalid or too large.
    """
    request_id = pending.request.request_id
    try:
        if isinstance(result, Exception):
            raise result
        if not isinstance(result, Act):
            raise PolicyFailed(f"act: expected an Act from the policy, got {type(result).__name__}")

        # The size is checked before the action is copied.
        size = getattr(result.action, "nbytes", 0)
        if size > limit:
            raise PolicyFailed(_too_large("action", size, limit))
        act = Act(check_action(result.action, contract), bool(result.done), result.info)
        # The policy may return a list of numbers, which has no `nbytes`.
        if act.action.nbytes > limit:
            raise PolicyFailed(_too_large("action", act.action.nbytes, limit))
        if act.info:
            require_serializable(act.info, limit - act.action.nbytes)

        # The result's own info takes precedence. The info may be None.
        act.info = {**policy, **(act.info or {})}
    except Exception as error:  # noqa: BLE001 - becomes the reply
        return Reply(request_id, error=public_error(error, pending))

    return Reply(request_id, act=act, step=session.advance())


def public_error(error: Exception, pending: PendingRequest) -> VLAgentsError:
    """Return the error for the caller; details of an error of the policy are only logged.

    Raises `KeyboardInterrupt` if the user has left a debugger in the policy.
    """
    if isinstance(error, VLAgentsError):
        return error
    if isinstance(error, BdbQuit):
        raise KeyboardInterrupt from error
    request = pending.request
    logger.error(
        "%s failed (session %s, request %s)",
        request.op,
        pending.session_id,
        request.request_id,
        exc_info=error,
    )
    if request.request_id:
        details = f"the server's log has the details under request id {request.request_id}"
    else:
        details = "its process wrote the traceback to stderr"
    return PolicyFailed(
        f"{request.op}: the policy raised {type(error).__name__}{raised_at(error)}; {details}"
    )


def raised_at(error: Exception) -> str:
    """Return the line of the user's own code that raised an error, " (my_policy.py:12)"; "" if no
    such line is known.
    """
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith(_LIBRARIES) and "site-packages" not in frame.filename:
            return f" ({Path(frame.filename).name}:{frame.lineno})"
    return ""


def timing(pending: PendingRequest, began: float, ended: float) -> dict[str, Any]:
    """Return how long a request waited for the policy's call, from `began` to `ended`, s, and how
    long the call took, ms.
    """
    return {"queue_ms": (began - pending.arrived) * 1e3, "inference_ms": (ended - began) * 1e3}


def require_serializable(info: dict[str, Any], limit: int = REPLY_BYTES) -> None:
    """Check that the info of a reply can be sent, so that an invalid info fails only the session's
    own request.

    Arrays are not copied. An info of more than `limit` bytes, or of more values than the client
    accepts, is rejected, since sending it would delay other replies.

    Raises:
        PolicyFailed: The info cannot be encoded, or is too large.
    """
    try:
        _BoundedWriter(limit).value(info)
    except InvalidInput as error:
        raise PolicyFailed(f"the policy's answer cannot be sent: {error}") from error


class _BoundedWriter(ValueWriter):
    """Encodes values within the limits that clients accept."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit
        self._bytes = self._values = self._depth = 0

    def value(self, value: Any) -> Any:
        """Encode a value as `ValueWriter` does; raise `MessageTooLarge` before a value over the
        limits is copied.
        """
        self._values += 1
        if self._values > DEFAULT_LIMITS.items:
            raise MessageTooLarge(
                f"info: more than {DEFAULT_LIMITS.items} values; send arrays instead of lists"
            )
        if value is None or isinstance(value, (int, float)):
            # Checked first, since checking the abstract classes below takes five times as long.
            return value
        if isinstance(value, (np.ndarray, memoryview)):
            self._bytes += value.nbytes
        elif isinstance(value, (str, bytes, bytearray)):
            self._bytes += len(value)
        elif isinstance(value, (Mapping, Sequence)):
            if self._depth >= DEFAULT_LIMITS.depth:
                raise MessageTooLarge(
                    f"info: nested deeper than {DEFAULT_LIMITS.depth}; flatten it"
                )
            self._depth += 1
            written = super().value(value)
            self._depth -= 1
            return written
        if self._bytes > self._limit:
            raise MessageTooLarge(_too_large("info", self._bytes, self._limit))
        return super().value(value)


def _too_large(field: str, size: int, limit: int) -> str:
    return f"{field}: expected at most {limit} bytes in a reply, got {size}; return less"
