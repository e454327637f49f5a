"""Which checkpoints a replica has room for: which sessions hold which, who waits, and what is to be done about it.

No threads; `vlagents_ray.serve.models` sees to it that one at a time is in here. Where there is no room

- the one that was used least recently and has no session goes;
- if all have sessions, whoever asks waits for episodes to end. After `PATIENCE_S` the checkpoint that has
  been here longest begins no further one, until it is free and has given way: so ten checkpoints have their
  turns with room for two, each for long enough to be worth its loading.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.errors import CheckpointFailed, DeadlineExceeded, UnknownSession, VLAgentsError
from vlagents_ray.serve.checkpoints import OWN, Checkpoints, Wish, resolved
from vlagents_ray.serve.model import Model, key_of
from vlagents_ray.serve.sessions import Session

PATIENCE_S = 10.0  # that somebody waits for room before a checkpoint in use begins no further episode

Then = Callable[[VLAgentsError | None], None]  # told that a session holds its model, or why it will not
Told = list[tuple[Then, VLAgentsError | None]]


@dataclass(slots=True, eq=False)
class Waiter:
    """A session whose episode waits for its checkpoint."""

    session: Session
    wish: Wish
    then: Then
    gone: Callable[[], bool]
    since: float = field(default_factory=time.monotonic)


@dataclass(frozen=True, slots=True)
class Load:
    """To be done: this has to be loaded."""

    wish: Wish
    settings: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Unload:
    """To be done: the model with that key has to go. `at_once`: its sessions end."""

    key: str  # not the model itself, whose memory shall be free as soon as it is gone
    at_once: bool = False


class Room:
    """The models that are loaded, and who waits for others."""

    def __init__(self, source: Checkpoints) -> None:
        self.config = source.config  # the deployment's own settings, as in effect
        self.next: dict[str, Any] | None = None  # to swap to
        self.failure: str | None = None  # of the last swap
        self.loaded: dict[str, Model] = {}  # by the settings' keys; the least recently used first
        self.waiting: list[Waiter] = []  # in order of arrival
        self.shut = ""  # the key of one that begins no further episode, to make room
        self._source = source

    def describe(self) -> dict[str, Any]:
        """What may be chosen, what is loaded, and what came of the last swap, for the metadata."""
        swap = None
        if self.next is not None:
            swap = {"state": "loading", "checkpoint": resolved(self.next)}
        elif self.failure is not None:
            swap = {"state": "failed", "error": self.failure}
        loaded = [model.checkpoint for model in self.loaded.values()]
        return {**self._source.describe(self.config), "loaded": loaded, "swap": swap}

    def offers(self, wish: Wish, settings: Mapping[str, Any]) -> bool:
        """Do these settings follow from that wish?"""
        return self._source.offers(wish, settings, self.config)

    def find(self, wish: Wish) -> Model | None:
        """What an episode would begin with now, if that is loaded."""
        return self.loaded.get(key_of(self._settings(wish)))

    def give(self, session: Session, model: Model) -> Model:
        """The session holds it from now on, and nothing else."""
        self.let_go(session)
        self.loaded[model.key] = self.loaded.pop(model.key)  # the most recently used is the last
        session.model = model
        model.sessions += 1
        return model

    def let_go(self, session: Session) -> bool:
        """The session holds nothing any more; did it?"""
        model, session.model = session.model, None
        if model is not None:
            model.sessions -= 1
        return model is not None

    def swap(self) -> Model | None:
        """To the settings wanted: the model of these, once it is loaded."""
        model = None if self.next is None else self.loaded.get(key_of(self.next))
        if self.next is not None and model is not None:
            self.config, self.next = self.next, None
        return model

    def settle(self) -> Told:
        """Those whose waiting is over, and what to tell them."""
        told: Told = []
        for waiter in list(self.waiting):
            model = self.find(waiter.wish)
            error: VLAgentsError | None = None
            if waiter.session.over:
                error = UnknownSession(f"session {waiter.session.id!r}: closed while it waited for {waiter.wish}")
            elif waiter.gone():
                error = too_late(waiter.wish)
            elif model is None or model.key == self.shut:
                continue
            else:
                self.give(waiter.session, model)
            self.waiting.remove(waiter)
            told.append((waiter.then, error))
        return told

    def plan(self) -> Load | Unload | None:
        """What is to be done next, if anything. Decides as well which one is `shut`."""
        self.shut = ""
        idle = [model for model in self.loaded.values() if not model.sessions]
        for model in idle:
            if not self.offers(model.wish, model.settings):
                return Unload(model.key)
        wanted = self._most_wanted()
        if wanted is None:
            return None
        work, since = wanted
        if len(self.loaded) < self._source.limit:
            return work
        old = None if self.next is None else self.config  # with which episodes begin while a swap loads: it goes last
        if idle:
            self.shut = min(idle, key=lambda model: model.settings == old).key
            return Unload(self.shut)
        oldest = min(self.loaded.values(), key=lambda model: (model.settings == old, model.since))
        if time.monotonic() - since > PATIENCE_S:
            self.shut = oldest.key
        if self.next is not None and self._source.limit == 1:
            return Unload(oldest.key, at_once=True)
        return None

    def failed(self, settings: dict[str, Any], failure: str) -> Told:
        """Those who waited for what did not load; whoever asks later has it tried again."""
        if settings == self.next:
            self.next, self.failure = None, failure  # the old one goes on
        failed = [waiter for waiter in self.waiting if self._settings(waiter.wish) == settings]
        self.waiting = [waiter for waiter in self.waiting if waiter not in failed]
        return [(waiter.then, CheckpointFailed(failure)) for waiter in failed]

    def _settings(self, wish: Wish) -> dict[str, Any]:
        return self._source.settings(wish, self.config)

    def _most_wanted(self) -> tuple[Load, float] | None:
        """What should be loaded next, and since when it has been waited for: a swap goes first."""
        if self.next is not None:
            return Load(OWN, self.next), float("-inf")
        for waiter in self.waiting:
            if self.find(waiter.wish) is None:
                return Load(waiter.wish, self._settings(waiter.wish)), waiter.since
        return None


def too_late(wish: Wish) -> DeadlineExceeded:
    """For a reset that nobody waits for any more."""
    return DeadlineExceeded(f"{wish} was not loaded in time; ask again, or allow more time")
