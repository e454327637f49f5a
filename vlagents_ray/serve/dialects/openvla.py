"""OpenVLA's REST: `POST /act` with an observation, answered with an action.

Its clients keep no session, so each request is an episode of one step; a client that sends `x-session-id` has one,
which begins again with each new instruction. Errors have their status and a problem+json document, where OpenVLA's own
server answers 200 and "error".
"""

from __future__ import annotations

from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import Response

from vlagents_ray.serve.conversation import Conversation
from vlagents_ray.serve.dialects.config import OpenVLA
from vlagents_ray.serve.dialects.door import Door, House, decoded, tellable
from vlagents_ray.serve.problems import problem_response
from vlagents_ray.serve.reading import Requests, request_id, session_id
from vlagents_ray.wire import openvla as wire
from vlagents_ray.wire.messages import SESSION_HEADER, Reply


class OpenVLADoor(Door):
    """Stateless unless the client names its session."""

    def __init__(self, dialect: OpenVLA, house: House) -> None:
        super().__init__("openvla", dialect, house)
        self._chunk = dialect.chunk
        self._requests = Requests(house.limits)
        self._kept: dict[str, Conversation] = {}  # by session, as the engine calls it

    async def act(self, http: HttpRequest) -> Response:
        """One request."""
        name = request_id(http)
        visit = self.visit()
        try:
            self.house.engine.require_ready()
            body = await self._requests.body(http)
            visit.arrive()
            theirs, twice = await decoded(wire.decode, body, self.house.limits)
            obs, instruction = self.read(theirs)
            visit.decoded_one()
            if SESSION_HEADER in http.headers:
                reply = await self._conversation(session_id(http)).act(obs, instruction, name)
            else:
                sender = self.sender(counted=True)
                try:
                    reply = await self.conversation(sender).act(obs, instruction, name)
                finally:
                    sender.release(for_good=True)
            return Response(visit.written(reply, lambda: self._answer(reply, twice)), media_type="application/json")
        except ClientDisconnect:
            visit.refused("disconnected")
            return Response(status_code=499)
        except Exception as error:  # noqa: BLE001 - it is told
            told = tellable(error, self.name, name)
            visit.refused(told.code)
            return problem_response(told, name)

    def _answer(self, reply: Reply, twice: bool) -> bytes:
        rows = self.rows(reply)
        return wire.encode(list(rows) if self._chunk else rows[0], twice)

    def _conversation(self, name: str) -> Conversation:
        """The session's, kept as long as the session is."""
        sessions = self.house.engine.sessions
        if len(self._kept) > 2 * len(sessions) + 16:
            self._kept = {kept: one for kept, one in self._kept.items() if kept in sessions}
        sender = self.sender(name)
        known = sender.session_id
        if known not in self._kept or known not in sessions:
            self._kept[known] = self.conversation(sender)
        return self._kept[known]
