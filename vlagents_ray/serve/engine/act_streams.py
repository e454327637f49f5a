"""Acts whose chunks are answered in parts: each part is sent as soon as the policy has computed its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vlagents_ray.errors import NotReset, PolicyFailed
from vlagents_ray.interface import Act
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.engine.responses import build_reply, timing
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.queue.batch_queue import BatchQueue, PendingRequest
from vlagents_ray.serve.sessions import Session, SessionTable
from vlagents_ray.serve.weights.versions import WeightsVersion

Acting = tuple[PendingRequest, Session[LoadedModel]]


class ActStreams:
    """Runs the acts of one engine whose clients take parts, on the policy's thread."""

    def __init__(
        self,
        sessions: SessionTable[LoadedModel],
        queue: BatchQueue,
        stats: MetricsBuffer,
        clock: Callable[[], float],
        batch_sizes: Sequence[int],
        reply_bytes: int,
    ) -> None:
        """Create the streams of one engine; see `Engine` for the last three arguments."""
        self._sessions = sessions
        self._queue = queue
        self._stats = stats
        self._clock = clock
        self._batch_sizes = batch_sizes
        self._reply_bytes = reply_bytes

    def run(self, model: LoadedModel, weights: WeightsVersion, acting: Sequence[Acting], prepared_s: float) -> None:
        """Answer the act requests of sessions with one version of one model's weights; see `Engine` for `prepared_s`.

        An act counts as one step, with its last part. One that fails later than with its first part is answered with
        the error after the parts so far. The policy stops early if no caller is left.
        """
        observations = [ticket.request.obs for ticket, _ in acting]
        agents = [session.agent for _, session in acting]
        padding = model.pad(observations, agents) if self._batch_sizes else 0
        rows = len(observations)
        padded: list[Act | Exception | None] = [None] * padding  # the last results of the padding
        waiting = dict(enumerate(acting))  # those that get further parts, by their place in the batch
        left_bytes = [self._reply_bytes] * len(acting)
        call = model.call("act_stream", rows if self._batch_sizes else None)

        def send(i: int, part: Act | Exception) -> None:
            ticket, session = acting[i]
            more = isinstance(part, Act) and part.more
            reply = build_reply(ticket, session, part, model.contract, left_bytes[i], weights.info, more=more)
            reply.timing = timing(ticket.arrived, call.began - prepared_s, self._clock())
            reply.timing["batch_size"] = len(acting)
            if more and reply.act is not None:
                left_bytes[i] -= reply.act.action.nbytes
                ticket.answer_part(reply)
            else:
                del waiting[i]
                ticket.answer(reply)

        try:
            with model.busy, model.uncaptured, call:
                model.require_open()
                model.parameters.use(weights)
                stream = model.agent.act_batch_stream(observations, agents)  # type: ignore[arg-type]
                del observations  # they may lie in memory that their sender needs back
                for ticket, _ in acting:
                    ticket.request.obs = None
                for parts in stream:
                    call.end_forked_child()
                    if len(parts) != rows:
                        raise PolicyFailed(f"act_batch_stream: got {rows} observations, yielded {len(parts)} parts")
                    if not any(self._goes_on(*waiting[i], parts[i]) for i in waiting):
                        stream.close()  # before the last replies, so that the observations are free
                    padded = [new or old for old, new in zip(padded, parts[len(acting) :], strict=True)]
                    for i, part in enumerate(parts[: len(acting)]):
                        if part is not None and i in waiting:
                            send(i, part)
            failure: Exception | None = None
        except Exception as error:  # noqa: BLE001 - becomes the replies
            failure, padded = error, [error] * padding
        for i, (ticket, _) in list(waiting.items()):
            send(i, failure or self._unfinished(ticket))
        model.calls.record_batch([failure] if failure else [None])
        model.padding.check_results(padded)
        self._stats.batch(len(acting), rows)

    def _goes_on(self, ticket: PendingRequest, session: Session[LoadedModel], part: Act | Exception | None) -> bool:
        """Return whether further parts follow, for a caller that still waits."""
        if ticket.cancelled or ticket.session_id not in self._sessions:
            return False
        return part is None or (isinstance(part, Act) and part.more)

    def _unfinished(self, ticket: PendingRequest) -> Exception:
        """Return the error of an act whose stream has ended without its last part."""
        if ticket.session_id not in self._sessions:
            return NotReset(f"session {ticket.session_id!r}: was closed during its act; reset first")
        return PolicyFailed("act_stream: it ended without a last part, i.e. one without `more`")
