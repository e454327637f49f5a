"""The messages of a WebSocket whose application receives requests: each message is charged when the
application receives it.
"""

from __future__ import annotations

from types import TracebackType
from typing import NamedTuple

from starlette.websockets import WebSocket, WebSocketState

from vlagents_ray.serve.access.api_keys import Identity
from vlagents_ray.serve.access.charges import REFUSED, Account, Charge

_POLICY_VIOLATION = 1008  # WebSocket close code


class ChargedMessage(NamedTuple):
    """A message, and its charge to the key of the client."""

    data: bytes | None  # None for a text message
    charge: Charge

    @property
    def size(self) -> int:
        """The number of bytes to decode; 0 for a text message, which is rejected."""
        return 0 if self.data is None else len(self.data)


class ChargedMessages:
    """The messages of one accepted WebSocket, as a context that ends after the last answer.

    `async for` returns one message after the other, until the client is gone. Messages stay unread
    while the key of the client is over its rate. After too many rejected messages in a row, the
    iteration ends, and the context closes the WebSocket.
    """

    def __init__(self, socket: WebSocket, caller: Identity) -> None:
        self._socket = socket
        self._account = Account(caller)

    def __aiter__(self) -> ChargedMessages:
        return self

    async def __anext__(self) -> ChargedMessage:
        """Wait for the next message, and charge it.

        Raises:
            StopAsyncIteration: The client is gone, or too many messages were rejected.
        """
        if self._account.refused_too_often:
            raise StopAsyncIteration
        await self._account.wait_unthrottled()
        event = await self._socket.receive()
        if event["type"] == "websocket.disconnect":
            raise StopAsyncIteration
        return ChargedMessage(event.get("bytes"), self._account.charge())

    async def __aenter__(self) -> ChargedMessages:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        is_open = self._socket.application_state is WebSocketState.CONNECTED
        if error is None and is_open and self._account.refused_too_often:
            await self._socket.close(_POLICY_VIOLATION, REFUSED)
