"""The checkpoints that a replica holds in memory: loaded when asked for, unloaded when the room is needed.

The first one is loaded on the policy's thread. From then on a thread of its own loads and unloads, one at
a time, while the sessions of the others act. Which of them, and for whom, is up to `vlagents_ray.serve.room`.

A deployment's own settings can change (`Models.configure`): the new ones are loaded beside the old, then
new episodes get them, and the old go when their last episode is over.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyUnavailable, UnknownSession, VLAgentsError
from vlagents_ray.interface import Agent
from vlagents_ray.serve.checkpoints import OWN, Checkpoints, Wish
from vlagents_ray.serve.model import Loader, Model, free_memory, key_of
from vlagents_ray.serve.room import Load, Room, Then, Told, Unload, Waiter
from vlagents_ray.serve.sessions import Session, SessionTable

logger = logging.getLogger(__name__)

_LOOK_S = 1.0  # how often it is looked whether those who wait are still there
_CLOSE_S = 10.0


class Models:
    """The models of a replica. Thread-safe; calls into other parts are made without its lock."""

    def __init__(self, source: Checkpoints, loader: Loader, sessions: SessionTable) -> None:
        """`sessions` are those that hold models: it tells which are over."""
        self.contract: Contract | None = None  # of the deployment's own, as loaded last
        self._source = source
        self._loader = loader
        self._sessions = sessions
        sessions.ended = self.release
        self._first: Agent | None = None
        self._fingerprint = ""
        self._room = Room(source)
        self._begun = self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._loop, name="checkpoints", daemon=True)

    @property
    def config(self) -> dict[str, Any]:
        """The deployment's own settings, as in effect."""
        return self._room.config

    def configure(self, config: Mapping[str, Any]) -> None:
        """The deployment's own settings: those to begin with or, once there are some, to swap to when loaded."""
        with self._changed:
            if not self._begun:
                self._begun, self._room.config, self._first = True, dict(config), self._source.make(config)
            else:
                self._room.next = None if config == self.config else dict(config)
                self._room.failure = None
                self._changed.notify_all()

    def start(self) -> None:
        """Load the deployment's own, on this thread; raises what keeps it from being served."""
        self._begun = True
        first, self._first = self._first, None
        model = self._loader.load(OWN, self.config, first)
        with self._changed:
            self._room.loaded[model.key] = model
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
            waiting, self._room.waiting = self._room.waiting, []
            loaded, self._room.loaded = self._room.loaded, {}
        _tell([(waiter.then, _stopping()) for waiter in waiting])
        for model in loaded.values():
            model.close()

    def check_health(self) -> None:
        """Raise what keeps one that is loaded from acting ever again."""
        with self._changed:
            loaded = list(self._room.loaded.values())
        for model in loaded:
            model.agent.check_health()

    @property
    def version(self) -> tuple[str, str]:
        """Equal in replicas of the same policy with the same settings of their own."""
        return self._loader.version(self.config), self._fingerprint

    def describe(self) -> dict[str, Any]:
        """What may be chosen, what is loaded, and what came of the last swap, for the metadata."""
        with self._changed:
            return self._room.describe()

    def loaded(self, wish: Wish) -> Model | None:
        """What an episode would begin with now, if that is loaded."""
        with self._changed:
            return self._room.find(wish)

    def hold(self, session: Session, wish: Wish, then: Then, gone: Callable[[], bool] = lambda: False) -> Model | None:
        """The model for a session's next episode, the session's until it asks again or is over.

        None if it has to be loaded or waited for: then `then` is called, with nothing once the session holds it,
        or with why it will not. `gone` says whether nobody waits for that any more.
        """
        with self._changed:
            self._require_open()
            self._let_go(session)
            model = self._room.find(wish)
            if model is not None and model.key != self._room.shut and not session.over:
                return self._room.give(session, model)
            self._room.waiting.append(Waiter(session, wish, then, gone))
            self._changed.notify_all()
            return None

    def adopt(self, session: Session, wish: Wish, settings: Mapping[str, Any], timeout_s: float) -> Model:
        """The model of a session that comes from another replica; `UnknownSession` if it cannot go on here.

        One that is offered here is loaded, if that takes no longer than `timeout_s`.
        """
        with self._changed:
            self._require_open()
            model = self._room.loaded.get(key_of(settings))
            if model is not None:
                return self._room.give(session, model)
            if timeout_s <= 0 or not self._room.offers(wish, settings):
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

    def _let_go(self, session: Session) -> None:
        if self._room.let_go(session):
            self._changed.notify_all()

    def _own(self, model: Model) -> None:
        self.contract, self._fingerprint = model.contract, model.copies.fingerprint

    def _loop(self) -> None:
        while (work := self._next_work()) is not None:
            try:
                if isinstance(work, Load):
                    self._load(work)
                elif isinstance(work, Unload):
                    self._unload(work)
                else:
                    _tell(work)
            except Exception:
                logger.exception("the checkpoints' thread goes on")

    def _next_work(self) -> Load | Unload | Told | None:
        """What is to be done, or whom to tell what; waits for some. None after `close`."""
        with self._changed:
            while not self._closed:
                if (model := self._room.swap()) is not None:
                    self._own(model)
                    logger.info("new episodes begin with %s", model.checkpoint)
                if told := self._room.settle():  # first, lest what was just loaded makes room for the next
                    return told
                shut = self._room.shut
                if (work := self._room.plan()) is not None:
                    return work
                if self._room.shut == shut:
                    self._changed.wait(_LOOK_S if self._room.waiting else None)
        return None

    def _load(self, work: Load) -> None:
        begun = time.monotonic()
        try:
            model = self._loader.load(work.wish, work.settings)
        except BaseException as error:
            logger.exception("%s did not load", work.wish)
            failure = f"{work.wish} did not load: {type(error).__name__}; the server's log says why"
            with self._changed:
                told = self._room.failed(work.settings, failure)
        else:
            logger.info("%s: loaded %s in %.1f s", work.wish, model.checkpoint, time.monotonic() - begun)
            with self._changed:
                if not self._closed:
                    self._room.loaded[model.key] = model
                    return
            model.close()
            return
        _tell(told)
        free_memory()

    def _unload(self, work: Unload) -> None:
        with self._changed:
            model = self._room.loaded[work.key]
        if work.at_once:
            logger.info("there is room for one checkpoint: its sessions end, for the next")
            self._sessions.close_those_of(model)
        with self._changed:
            if work.at_once and model.sessions:  # one arrives from another replica, and is in no table yet
                self._changed.wait(_LOOK_S)
            if model.sessions:  # or one came meanwhile
                return
            del self._room.loaded[work.key]
        logger.info("%s: unloading %s", model.wish, model.checkpoint)
        model.close()
        del model
        free_memory()


def _stopping() -> PolicyUnavailable:
    return PolicyUnavailable("the replica is stopping; connect again")


def _tell(told: Told) -> None:
    for then, error in told:
        then(error)
