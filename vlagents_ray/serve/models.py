"""The checkpoints that a replica holds in memory: loaded when asked for, unloaded when the room is needed.

The first one is loaded on the policy's thread. From then on a thread of its own loads and unloads, one at
a time, while the sessions of the others act. Where there is no room

- the one that was used least recently and has no session goes;
- if all have sessions, whoever asks waits for episodes to end. After `PATIENCE_S` the checkpoint that has
  been here longest begins no further one, until it is free and has given way: so ten checkpoints have their
  turns with room for two, each for long enough to be worth its loading.

A deployment's own settings can change (`Models.configure`): the new ones are loaded beside the old, then
new episodes get them, and the old go when their last episode is over.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import CheckpointFailed, DeadlineExceeded, PolicyUnavailable, UnknownSession, VLAgentsError
from vlagents_ray.interface import Agent
from vlagents_ray.serve.checkpoints import OWN, Checkpoints, Wish, resolved
from vlagents_ray.serve.model import Loader, Model, free_memory, key_of
from vlagents_ray.serve.sessions import Session, SessionTable

logger = logging.getLogger(__name__)

PATIENCE_S = 10.0  # that somebody waits for room before a checkpoint in use begins no further episode
_LOOK_S = 1.0  # how often it is looked whether those who wait are still there
_CLOSE_S = 10.0

Then = Callable[[VLAgentsError | None], None]  # told that a session holds its model, or why it will not


@dataclass(slots=True, eq=False)
class _Waiter:
    session: Session
    wish: Wish
    then: Then
    gone: Callable[[], bool]
    since: float = field(default_factory=time.monotonic)


class Models:
    """The models of a replica. Thread-safe; calls into other parts are made without its lock."""

    def __init__(self, source: Checkpoints, loader: Loader, sessions: SessionTable) -> None:
        """`sessions` are those that hold models: it tells which are over."""
        self.contract: Contract | None = None  # of the deployment's own, as loaded last
        self.config = source.config  # the deployment's own settings, as in effect
        self._source = source
        self._loader = loader
        self._sessions = sessions
        sessions.ended = self.release
        self._first: Agent | None = None
        self._fingerprint = ""
        self._next: dict[str, Any] | None = None  # settings to swap to
        self._failure: str | None = None  # of the last swap
        self._loaded: dict[str, Model] = {}  # by the settings' keys; the least recently used first
        self._waiting: list[_Waiter] = []  # in order of arrival
        self._shut = ""  # the key of one that begins no further episode, to make room
        self._begun = self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._loop, name="checkpoints", daemon=True)

    def configure(self, config: Mapping[str, Any]) -> None:
        """The deployment's own settings: those to begin with or, once there are some, to swap to when loaded."""
        with self._changed:
            if not self._begun:
                self._begun, self.config, self._first = True, dict(config), self._source.make(config)
            else:
                self._next = None if config == self.config else dict(config)
                self._failure = None
                self._changed.notify_all()

    def start(self) -> None:
        """Load the deployment's own, on this thread; raises what keeps it from being served."""
        self._begun = True
        first, self._first = self._first, None
        model = self._loader.load(OWN, self.config, first)
        with self._changed:
            self._loaded[model.key] = model
            self._own(model)
        self._thread.start()

    def close(self) -> None:
        """Unload everything; who waits is turned away."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.ident is not None:
            self._thread.join(_CLOSE_S)
        with self._changed:
            waiting, self._waiting = self._waiting, []
            loaded, self._loaded = self._loaded, {}
        for waiter in waiting:
            waiter.then(_stopping())
        for model in loaded.values():
            model.close()

    def check_health(self) -> None:
        """Raise what keeps one that is loaded from acting ever again."""
        with self._changed:
            loaded = list(self._loaded.values())
        for model in loaded:
            model.agent.check_health()

    @property
    def version(self) -> tuple[str, str]:
        """Equal in replicas of the same policy with the same settings of their own."""
        return self._loader.version(self.config), self._fingerprint

    def describe(self) -> dict[str, Any]:
        """What may be chosen, what is loaded, and what came of the last swap, for the metadata."""
        with self._changed:
            swap = None
            if self._next is not None:
                swap = {"state": "loading", "checkpoint": resolved(self._next)}
            elif self._failure is not None:
                swap = {"state": "failed", "error": self._failure}
            loaded = [model.checkpoint for model in self._loaded.values()]
            return {**self._source.describe(self.config), "loaded": loaded, "swap": swap}

    def loaded(self, wish: Wish) -> Model | None:
        """What an episode would begin with now, if that is loaded."""
        return self._loaded.get(self._key(wish))

    def hold(self, session: Session, wish: Wish, then: Then, gone: Callable[[], bool] = lambda: False) -> Model | None:
        """The model for a session's next episode, the session's until it asks again or is over.

        None if it has to be loaded or waited for: then `then` is called, with nothing once the session holds it,
        or with why it will not. `gone` says whether nobody waits for that any more.
        """
        with self._changed:
            self._require_open()
            self._let_go(session)
            model = self._loaded.get(self._key(wish))
            if model is not None and model.key != self._shut and not session.over:
                return self._give(session, model)
            self._waiting.append(_Waiter(session, wish, then, gone))
            self._changed.notify_all()
            return None

    def adopt(self, session: Session, wish: Wish, settings: Mapping[str, Any], timeout_s: float) -> Model:
        """The model of a session that comes from another replica; `UnknownSession` if it cannot go on here.

        One that is offered here is loaded, if that takes no longer than `timeout_s`.
        """
        with self._changed:
            self._require_open()
            model = self._loaded.get(key_of(settings))
            if model is not None:
                return self._give(session, model)
            if timeout_s <= 0 or not self._source.offers(wish, settings, self.config):
                raise UnknownSession(f"session {session.id!r}: {wish} is not loaded here; reset it")
        done = threading.Event()
        errors: list[VLAgentsError] = []

        def then(error: VLAgentsError | None) -> None:
            errors.extend([] if error is None else [error])
            done.set()

        if self.hold(session, wish, then) is None:
            done.wait(timeout_s)
        if session.model is None:
            raise errors[0] if errors else UnknownSession(f"session {session.id!r}: {wish} takes long; reset it")
        return session.model

    def pass_on(self, session: Session, to: Session) -> None:
        """What one session holds is the other's from now on, unless that is over."""
        with self._changed:
            self._let_go(to)
            if not to.over:
                to.model, session.model = session.model, None

    def let_go(self, session: Session) -> None:
        """The session has no episode."""
        with self._changed:
            self._let_go(session)

    def release(self, session: Session) -> None:
        """The session is over."""
        with self._changed:
            session.over = True
            self._let_go(session)

    def _require_open(self) -> None:
        if self._closed:
            raise _stopping()

    def _key(self, wish: Wish) -> str:
        return key_of(self._source.settings(wish, self.config))

    def _let_go(self, session: Session) -> None:
        model, session.model = session.model, None
        if model is not None:
            model.sessions -= 1
            self._changed.notify_all()

    def _give(self, session: Session, model: Model) -> Model:
        self._let_go(session)
        self._loaded[model.key] = self._loaded.pop(model.key)  # the most recently used is the last
        session.model = model
        model.sessions += 1
        return model

    def _own(self, model: Model) -> None:
        self.contract, self._fingerprint = model.contract, model.copies.fingerprint

    def _loop(self) -> None:
        while (work := self._next_work()) is not None:
            try:
                work()
            except Exception:
                logger.exception("the checkpoints' thread goes on")

    def _next_work(self) -> Callable[[], None] | None:
        with self._changed:
            while not self._closed:
                self._swap()
                if told := self._settle():  # first, lest what was just loaded makes room for the next
                    return partial(_tell, told)
                shut = self._shut
                if (work := self._plan()) is not None:
                    return work
                if self._shut == shut:
                    self._changed.wait(_LOOK_S if self._waiting else None)
        return None

    def _swap(self) -> None:
        """To the settings wanted, once what they name is loaded."""
        if self._next is not None and (model := self._loaded.get(key_of(self._next))) is not None:
            self.config, self._next = self._next, None
            self._own(model)
            logger.info("new episodes begin with %s", model.checkpoint)

    def _plan(self) -> Callable[[], None] | None:
        """What is to be done next, if anything."""
        self._shut = ""
        idle = [model for model in self._loaded.values() if not model.sessions]
        for model in idle:
            if not self._source.offers(model.wish, model.settings, self.config):
                return partial(self._unload, model.key)
        wanted = self._most_wanted()
        if wanted is None:
            return None
        wish, settings, since = wanted
        if len(self._loaded) < self._source.limit:
            return partial(self._load, wish, settings)
        old = None if self._next is None else self.config  # with which episodes begin while a swap loads: it goes last
        if idle:
            self._shut = min(idle, key=lambda model: model.settings == old).key
            return partial(self._unload, self._shut)
        oldest = min(self._loaded.values(), key=lambda model: (model.settings == old, model.since))
        if time.monotonic() - since > PATIENCE_S:
            self._shut = oldest.key
        if self._next is not None and self._source.limit == 1:
            return partial(self._make_way, oldest)
        return None

    def _most_wanted(self) -> tuple[Wish, dict[str, Any], float] | None:
        """What should be loaded next, and since when it has been waited for: a swap goes first."""
        if self._next is not None:
            return OWN, self._next, float("-inf")
        for waiter in self._waiting:
            settings = self._source.settings(waiter.wish, self.config)
            if key_of(settings) not in self._loaded:
                return waiter.wish, settings, waiter.since
        return None

    def _settle(self) -> list[tuple[Then, VLAgentsError | None]]:
        """Those whose waiting is over, and what to tell them."""
        told: list[tuple[Then, VLAgentsError | None]] = []
        for waiter in list(self._waiting):
            model = self._loaded.get(self._key(waiter.wish))
            error: VLAgentsError | None = None
            if waiter.session.over:
                error = UnknownSession(f"session {waiter.session.id!r}: closed while it waited for {waiter.wish}")
            elif waiter.gone():
                error = too_late(waiter.wish)
            elif model is None or model.key == self._shut:
                continue
            else:
                self._give(waiter.session, model)
            self._waiting.remove(waiter)
            told.append((waiter.then, error))
        return told

    def _load(self, wish: Wish, settings: dict[str, Any]) -> None:
        begun = time.monotonic()
        try:
            model = self._loader.load(wish, settings)
        except BaseException as error:
            logger.exception("%s did not load", wish)
            failure = f"{wish} did not load: {type(error).__name__}; the server's log says why"
            with self._changed:
                told = self._failed(settings, failure)
        else:
            logger.info("%s: loaded %s in %.1f s", wish, model.checkpoint, time.monotonic() - begun)
            with self._changed:
                if not self._closed:
                    self._loaded[model.key] = model
                    return
            model.close()
            return
        _tell(told)
        free_memory()

    def _failed(self, settings: dict[str, Any], failure: str) -> list[tuple[Then, VLAgentsError | None]]:
        """Those who waited for what did not load; whoever asks later has it tried again."""
        if settings == self._next:
            self._next, self._failure = None, failure  # the old one goes on
        failed = [w for w in self._waiting if self._source.settings(w.wish, self.config) == settings]
        self._waiting = [waiter for waiter in self._waiting if waiter not in failed]
        return [(waiter.then, CheckpointFailed(failure)) for waiter in failed]

    def _unload(self, key: str) -> None:
        with self._changed:
            if self._loaded[key].sessions:  # one came meanwhile
                return
            model = self._loaded.pop(key)
        logger.info("%s: unloading %s", model.wish, model.checkpoint)
        model.close()
        del model
        free_memory()

    def _make_way(self, model: Model) -> None:
        logger.info("there is room for one checkpoint: its sessions end, for the next")
        self._sessions.close_those_of(model)
        with self._changed:  # one that arrives from another replica is in no table yet
            self._changed.wait_for(lambda: self._closed or not model.sessions, _LOOK_S)


def too_late(wish: Wish) -> DeadlineExceeded:
    """For a reset that nobody waits for any more."""
    return DeadlineExceeded(f"{wish} was not loaded in time; ask again, or allow more time")


def _stopping() -> PolicyUnavailable:
    return PolicyUnavailable("the replica is stopping; connect again")


def _tell(told: list[tuple[Then, VLAgentsError | None]]) -> None:
    for then, error in told:
        then(error)
