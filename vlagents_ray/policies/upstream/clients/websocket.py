"""A WebSocket to an upstream."""

from __future__ import annotations

import contextlib
import inspect
import logging
from typing import TYPE_CHECKING, Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.protocol import State
from websockets.sync.client import connect

from vlagents_ray.errors import ConnectionLost, PolicyUnavailable, Unauthorized

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

    from vlagents_ray.policies.upstream.clients.base import ClientOptions

_LOG = logging.getLogger("vlagents_ray.upstream.websocket")
_LOG.setLevel(logging.CRITICAL)  # it logs each lost connection as an error, which is raised as well
_CLOSE_S = 1
_REFUSED = (401, 403)
# An upstream that computes on its event loop answers no pings meanwhile. Older versions of `websockets` send none.
_NO_PINGS: dict[str, Any] = {"ping_interval": None} if "ping_interval" in inspect.signature(connect).parameters else {}


class UpstreamSocket:
    """A WebSocket to an upstream, which bounds the size of messages and the time of waiting.

    A thread of its own answers the upstream's pings, so that a connection stays open while no session acts.
    """

    def __init__(self, options: ClientOptions, headers: dict[str, str]) -> None:
        self._options = options
        self._headers = headers
        self._connection: ClientConnection | None = None
        self._open = contextlib.ExitStack()

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent."""
        return self._connection is not None and self._connection.protocol.state is State.OPEN

    def open(self, timeout_s: float) -> None:
        """Connect; raises `PolicyUnavailable` if it cannot be reached, `Unauthorized` if it refuses the key."""
        url = self._options.url
        try:
            opening = connect(
                url,
                open_timeout=timeout_s,
                close_timeout=_CLOSE_S,
                compression=None,
                max_size=self._options.limits.body_bytes,
                additional_headers=self._headers,
                logger=_LOG,
                **_NO_PINGS,
            )
            self._connection = self._open.enter_context(opening)
        except InvalidStatus as error:
            if error.response.status_code in _REFUSED:
                raise Unauthorized(
                    f"upstream {url}: it refuses the API key (HTTP {error.response.status_code}); name the environment "
                    f"variable with the right one in key_env"
                ) from error
            raise PolicyUnavailable(f"upstream {url}: refused with HTTP {error.response.status_code}") from error
        except (OSError, InvalidHandshake, ConnectionClosed, TimeoutError) as error:
            raise PolicyUnavailable(f"upstream {url}: cannot connect ({error}); is it running?") from error

    def send(self, message: bytes) -> None:
        """Send a binary message; raises `ConnectionLost`."""
        try:
            self._opened().send(message)
        except (ConnectionClosed, OSError) as error:
            raise self._lost(str(error)) from error

    def recv(self, timeout_s: float | None = None) -> bytes | str:
        """Return the next message.

        Raises:
            ConnectionLost: The connection broke, or no message came in time.
        """
        wait_s = self._options.timeout_s if timeout_s is None else timeout_s
        try:
            return self._opened().recv(timeout=wait_s)
        except TimeoutError as error:
            raise self._lost(f"no answer within {wait_s:.3g} s") from error
        except (ConnectionClosed, OSError) as error:
            raise self._lost(str(error)) from error

    def close(self) -> None:
        """Close the connection."""
        self._connection = None
        self._open.close()

    def _opened(self) -> ClientConnection:
        if self._connection is None:
            raise ConnectionLost(f"upstream {self._options.url}: the connection is closed")
        return self._connection

    def _lost(self, text: str) -> ConnectionLost:
        self.close()
        return ConnectionLost(f"upstream {self._options.url}: {text}")
