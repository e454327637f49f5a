"""The messages of our own protocol on a WebSocket: frames of requests, and probes of the link."""

from __future__ import annotations

import time
from functools import partial

from vlagents_ray.errors import MalformedMessage, VLAgentsError
from vlagents_ray.protocol import messages
from vlagents_ray.protocol.compact import STREAM_TAG, CompactReader, is_compact
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.serve.access.api_keys import Identity
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.endpoints.connection import (
    LEAST_WAIT_S,
    MOST_UNANSWERED,
)
from vlagents_ray.serve.endpoints.websocket_connection import MessageHandler, WebSocketConnection
from vlagents_ray.serve.engine.admission import MessageAdmission, image_bytes
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.requests import IncomingMessage


class StreamForms:
    """The forms of messages on one WebSocket: frames, and compact acts (`protocol.compact`)."""

    def __init__(self, limits: messages.MessageLimits) -> None:
        self._reader = CompactReader(limits)
        self._answers_compact = False  # whether the client reads answers in compact form

    def decode(self, message: bytes, budget: messages.Budget) -> Decoded:
        """Return the requests of a message.

        Raises:
            InvalidInput: The message is malformed.
            TooManyRequests: The sender's key is over its rate.
        """
        if is_compact(message):
            self._answers_compact = True
            return self._reader.read_stream(message, budget)
        return decode_requests(message, budget)

    def encode(self, message: IncomingMessage) -> bytes:
        """Return the answers of a message, in compact form if the client sends and reads it."""
        compact = answers.as_compact(message) if self._answers_compact else None
        return answers.as_frame(message) if compact is None else STREAM_TAG + compact


class RequestStream(MessageHandler):
    """Decodes the frames of a WebSocket, submits their requests, and sends the answers."""

    most_unanswered = MOST_UNANSWERED

    def __init__(
        self,
        connection: WebSocketConnection,
        engine: Engine,
        limits: messages.MessageLimits,
        caller: Identity,
    ) -> None:
        self._connection = connection
        self._engine = engine
        self._limits = limits
        self._forms = StreamForms(limits)
        self._sender = Sender(
            engine, "websocket", caller=caller, has_left=connection.has_left, can_move=True
        )
        self.most_unanswered_bytes = limits.body_bytes

    def begin(self) -> Charge:
        return self._connection.account.charge()

    def receive(self, message: bytes | str, arrived: float, charge: Charge | None) -> None:
        charge = charge or self._connection.account.charge()
        incoming = self._sender.message(charge)
        admission = message_admission(self._engine, charge, self._limits, len(message))
        try:
            admission.begin_message()
            if isinstance(message, str):
                raise MalformedMessage("stream: expected a binary message, got a text")
            if messages.is_probe(message):
                messages.read_probe(message, admission)
                self._connection.send(messages.probe_answer(len(message)))
                return

            self._connection.decode(
                partial(self._forms.decode, message),
                admission,
                partial(self._submit, incoming, admission, len(message), arrived),
                partial(self._refuse, incoming),
            )
        except VLAgentsError as error:
            self._refuse(incoming, error)

    def ended(self, code: int) -> None:
        self._sender.release()

    def finish(self, reason: str, code: int) -> None:
        self._connection.end_when_answered(reason, code)

    def _submit(
        self,
        incoming: IncomingMessage,
        admission: MessageAdmission,
        size: int,
        arrived: float,
        decoded: Decoded,
    ) -> None:
        """Send the requests of a message to the engine; their deadlines count from the arrival
        of the message.
        """
        incoming.decoded(decoded)
        waited_s = time.perf_counter() - arrived
        incoming.size = size + sum(map(image_bytes, decoded.requests))
        self._connection.add_unanswered(incoming.size)
        self._sender.send(
            incoming,
            decoded,
            self,
            admission=admission,
            waited_s=waited_s if waited_s > LEAST_WAIT_S else 0.0,
            # For TCP, the kernel records the time of the last segment, which may be the segment
            # that ends the client's connection.
            may_have_waited=True,
        )

    def deliver(self, message: IncomingMessage) -> None:
        """Send the answers of a message, and read again if the client had too many unanswered
        messages.
        """
        # A message that was rejected before its requests were sent has no admission.
        if message.size:
            self._connection.remove_unanswered(message.size)
        self._connection.send_answers(message, self._send, self._engine.stats)

    def _refuse(self, incoming: IncomingMessage, error: VLAgentsError) -> None:
        incoming.refuse(error)
        self.deliver(incoming)

    def _send(self, message: IncomingMessage) -> None:
        self._connection.send(self._forms.encode(message))
