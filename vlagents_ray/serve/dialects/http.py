"""Dialects of plain HTTP, in which each request is an observation and each reply an action."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import Response

from vlagents_ray.protocol.messages import SESSION_HEADER, Budget
from vlagents_ray.serve.access.api_keys import Identity, current_caller
from vlagents_ray.serve.config.dialects import DialectConfig
from vlagents_ray.serve.dialects.base import ReplicaContext, RouteDialect, decoded, public_problem
from vlagents_ray.serve.dialects.implicit_session import ImplicitSession
from vlagents_ray.serve.endpoints.http_messages import RequestDecoder, problem_response, request_id, session_id


class HttpDialect(RouteDialect):
    """A dialect of HTTP requests.

    Each request is an episode of one step, unless it has the header `x-session-id`: then it belongs to that session,
    in which each new instruction begins an episode. Errors have their status and a problem+json document.
    """

    def __init__(self, name: str, config: DialectConfig, context: ReplicaContext) -> None:
        super().__init__(name, config, context)
        self._requests = RequestDecoder(context.limits)
        # The sessions by caller and session id in the engine. A new key with the name of a revoked one continues the
        # sessions of that name, but not with the revoked key.
        self._kept: dict[tuple[Identity, str], ImplicitSession] = {}

    async def answer(
        self,
        http: HttpRequest,
        read: Callable[[bytes, Budget], Any],
        write: Callable[[np.ndarray], bytes],
        media_type: str = "application/json",
    ) -> Response:
        """Answer one request.

        Args:
            http: The request.
            read: Decodes the body to the client's observation, within a budget; it may run on another thread.
            write: Encodes the action, (H, D) float32 in the client's convention, as the body of the reply.
            media_type: The media type of the reply.
        """
        name = request_id(http)
        message = self.arrived()
        admission = self.gate(counted=True).admission(self.context.limits, rank=self.rank)
        try:
            self.context.engine.require_ready()
            body = await self._requests.body(http, admission)
            message.arrive()
            theirs = await decoded(read, body, admission)
            obs, instruction = self.read(theirs)
            message.decoded_alike()
            session = self._kept_session(session_id(http)) if SESSION_HEADER in http.headers else None
            if session is None or not session.episode.begun:
                self.mapping.warn_of_unread_cameras(theirs, self.name)
            if session is not None:
                reply = await session.act(message, obs, instruction, name)
            else:
                sender = self.sender()
                try:
                    reply = await self.session(sender).act(message, obs, instruction, name)
                finally:
                    sender.release(for_good=True)
            return Response(message.written(lambda: write(self.rows(reply))), media_type=media_type)
        except ClientDisconnect:
            message.refused("disconnected")
            return Response(status_code=499)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, self.name, name)
            message.refused(problem.code)
            return problem_response(problem, name)
        finally:
            admission.release()

    def _kept_session(self, name: str) -> ImplicitSession:
        """Return the session that a client names, which is kept as long as the engine keeps it."""
        sessions = self.context.engine.sessions
        if len(self._kept) > 2 * len(sessions) + 16:
            self._kept = {kept: one for kept, one in self._kept.items() if kept[1] in sessions}
        sender = self.sender(name)
        known = (current_caller(), sender.session_id)
        if known not in self._kept or known[1] not in sessions:
            self._kept[known] = self.session(sender)
        return self._kept[known]
