"""What a live replica does for the candidate of its deployment: it sends, and never waits."""

from __future__ import annotations

import pickle
from collections.abc import Collection, Sequence
from typing import Any

import ray

from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.protocol.frames import encode_replies
from vlagents_ray.serve.config.deployment import ShadowArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.replica.candidate import CandidateReplica
from vlagents_ray.serve.shadow.sender import ShadowSender, Turn


class CandidateLink:
    """Calls the candidate's replica, which is looked up again when it is gone; see `vlagents_ray.serve.shadow.sender`.

    Serve's own router takes longer for a call, and holds the interpreter's lock meanwhile.
    """

    def __init__(self, handle: Any) -> None:
        """`handle` is that of the candidate's deployment."""
        self._handle = handle
        self._actor: Any = None

    def __call__(self, turns: Sequence[Turn]) -> Collection[str]:
        """Send turns, and wait for the candidate without a limit: its own `limits` are those of its calls."""
        try:
            if self._actor is None:  # waits until the candidate has loaded
                self._actor = self._handle.actor.remote().result()
            frames = [pickle.PickleBuffer(turn.frame) for turn in turns]
            live = pickle.PickleBuffer(encode_replies([turn.reply for turn in turns]))
            sessions, dropped = [turn.session for turn in turns], [turn.dropped for turn in turns]
            pending = call_replica(self._actor, CandidateReplica.follow, sessions, frames, live, dropped)
            lost: Collection[str] = ray.get(pending)
        except ray.exceptions.RayError as error:
            self._actor = None
            raise PolicyUnavailable(f"shadow: {type(error).__name__}; it is looked up again") from error
        return lost


class ReplicaShadow:
    """A part of `PolicyReplica`: what it sends to the candidate."""

    def _open_shadow(self, engine: Engine, args: ShadowArgs | None, candidate: Any) -> None:
        """Begin to send to the `candidate`, a handle, if the deployment has one."""
        self._shadow: ShadowSender | None = None
        self._shadow_description = None if args is None else args.model_dump(include={"policy", "share"})
        self._drops_read = 0
        if args is not None:
            self._shadow = ShadowSender(
                CandidateLink(candidate), args.share, args.queue, is_open=engine.sessions.__contains__
            )
            self._shadow.start()
            engine.observers.add(self._shadow)
        self._followed = engine.observers

    def _shadow_drops(self) -> int:
        """Return the number of observations since the last call that the candidate did not get."""
        if self._shadow is None:
            return 0
        before, self._drops_read = self._drops_read, self._shadow.dropped
        return self._drops_read - before

    def _close_shadow(self) -> None:
        if self._shadow is not None:
            self._followed.remove(self._shadow)
            self._shadow.close()
