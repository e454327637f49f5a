"""The request router for Serve's Python proxy, which is used if HAProxy is not the ingress.

Serve sends this module by value to its proxies, so it imports no other module of this package. It
uses private names of Serve (read in Ray 2.60): `RequestRouter._choose_replica_for_request`,
`_replicas`, `_handle_source` and `_deployment_id`.
"""

from __future__ import annotations

import asyncio
from typing import Any

from ray.serve.exceptions import BackPressureError
from ray.serve.experimental.consistent_hash_router import ConsistentHashRouter

# Longest wait for a replica. `/healthz` must be answered within 2 s, and a waiting request makes
# Serve start a replica of an idle application.
_WAIT_S = 1.5
_RETRY_AFTER_S = 1


class _NoReplica(BackPressureError):  # type: ignore[misc]
    """Raised if no replica is running; Serve's proxy answers with 503 and `retry-after`."""

    def __init__(self, app: str) -> None:
        super().__init__(0, 0, retry_after_s=_RETRY_AFTER_S)
        self._message = (
            f"no replica of application {app!r} runs: its policy loads, or waits for "
            "resources; try again"
        )


class SessionRouter(ConsistentHashRouter):  # type: ignore[misc]
    """Routes a session's requests to one replica, according to the session header. If there is no
    replica, the proxy answers 503.
    """

    async def _choose_replica_for_request(
        self, pending_request: Any, *, is_retry: bool = False
    ) -> Any:
        chosen = super()._choose_replica_for_request(pending_request, is_retry=is_retry)
        if self._replicas or self._handle_source.name != "PROXY":
            return await chosen
        choice = asyncio.ensure_future(chosen)
        try:
            await asyncio.wait({choice}, timeout=_WAIT_S)
            if choice.done() or self._replicas:
                return await choice
            raise _NoReplica(self._deployment_id.app_name)
        finally:
            choice.cancel()
