"""The versions of one model's weights: which are held, which one the agent has, and which one each
session acts with.

Version 0 is the loaded checkpoint. A push stages a version, which is checked and held but not used,
and commits it when all replicas hold it; a part of the replica coordinates that (`serve.replica`).
A commit copies and loads nothing: before a batch, a reset or an observation, the policy's thread
loads the sessions' version into the agent (`ModelWeights.use`), which takes no time if the agent
has it already. A version is freed when no session acts with it and it is neither the newest nor the
pinned one.

On a GPU, the agent's version is that in its parameters, where another one takes its place. Two
versions share its memory, the agent's and a staged one; those with which no session acts are in the
memory of the host meanwhile.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeVar, get_args
from weakref import WeakValueDictionary, ref

import numpy as np

from vlagents_ray.errors import (
    InvalidInput,
    MessageTooLarge,
    NotTrainable,
    Overloaded,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
    WeightsNotStaged,
)
from vlagents_ray.interface import POLICY, Agent
from vlagents_ray.policies.base.accelerator import empty_cache, free_memory, is_out_of_memory
from vlagents_ray.policies.compilation import CAPTURES
from vlagents_ray.policies.wrapper import Wrapper
from vlagents_ray.weights import trainable
from vlagents_ray.weights.safetensors import ValueSpec, read_header
from vlagents_ray.weights.shared_values import SharedValues, gpu_of, opened, readable_gpus
from vlagents_ray.weights.trainable import beside_acts

logger = logging.getLogger(__name__)

T = TypeVar("T")

STAGED_S = 60.0  # time for which a staged version waits for its commit, s

PushMode = Literal["keep", "next_episode"]
"""When a session changes to a new version: between two of its acts, or at its next reset."""
RestStep = Literal["sleep", "restore", "wake"]
"""No acts, and less memory; the memory back, still without acts; and acts again."""
OPTION = "weights"  # option of a reset
_LARGEST = 2**53 - 1  # largest version number, which JSON represents exactly
_LONGEST_REST_S = 86_400.0
_FOLLOW, _PINNED = "follow", "pinned"


@dataclass(frozen=True, slots=True)
class PushOptions:
    """The options of a push."""

    mode: PushMode = "next_episode"  # when sessions change
    partial: bool = False  # whether names may be missing, whose values are kept
    allow_same: bool = False  # whether all values may equal those of the newest version
    # Whether sessions that do not follow the newest version also get it, at their next reset.
    pin: bool = False
    # Its number, such as the training step; by default the newest one's + 1.
    version: int | None = None

    def __post_init__(self) -> None:
        if self.version is not None and not 1 <= self.version <= _LARGEST:
            raise InvalidInput(f"version: expected a number in [1, {_LARGEST}], got {self.version}")
        if self.mode not in get_args(PushMode):
            raise InvalidInput(
                f"mode: expected one of {list(get_args(PushMode))}, got {self.mode!r}"
            )


class VersionNotHeld(UnknownSession):
    """Raised if a session acts with a version of the weights that the replica does not hold."""


class WeightsVersion:
    """One version of a model's weights."""

    __slots__ = ("__weakref__", "fingerprint", "info", "number", "on_host", "values")

    def __init__(self, number: int, digest: str, values: dict[str, Any] | None) -> None:
        self.number = number
        self.fingerprint = digest
        self.values = values  # by name; None if the agent alone holds them
        self.on_host = False  # whether they were moved out of the GPU's memory
        self.info = {POLICY: {"version": number, "fingerprint": digest}}  # for the info of each act


@dataclass(frozen=True, slots=True)
class Rest:
    """A step between acting and acting again."""

    step: RestStep
    # Whether "sleep" moves weights to the memory of the host, and frees CUDA graphs.
    offload: bool = True
    # Time after which a replica wakes by itself, since its learner may have died, s.
    at_most_s: float = 600.0

    def __post_init__(self) -> None:
        if self.step not in get_args(RestStep):
            raise InvalidInput(
                f"step: expected one of {list(get_args(RestStep))}, got {self.step!r}"
            )
        if not 0 < self.at_most_s <= _LONGEST_REST_S:
            raise InvalidInput(
                f"at_most_s: expected seconds in (0, {_LONGEST_REST_S:g}], got {self.at_most_s:g}"
            )


class FollowingSession(Protocol):
    """The part of a session's interface that concerns weights."""

    weights: WeightsVersion | None  # version that it acts with; None without an episode
    follows: bool  # whether it uses the newest version, otherwise the pinned one


class ModelWeights:
    """The versions of one model. Thread-safe, except `use`, which runs on the policy's thread."""

    def __init__(
        self,
        agent: Agent,
        busy: threading.Lock,
        digest: str = "",
        model: tuple[str, str] = ("", ""),
    ) -> None:
        """Make the weights of an initialized agent version 0.

        Args:
            agent: The agent, which acts with one version at a time.
            busy: The lock that is held while the agent runs.
            digest: The fingerprint of an agent that names no parameters.
            model: A value that is equal in replicas with the same checkpoint and settings.
        """
        self.model = model
        self.gpus: tuple[str, ...] = ()  # see `NewestVersion`
        self._agent, self._busy = agent, busy
        self._device: Any = "cpu"  # the GPU of its values, if they are on one
        # The agent's, if another version takes their place in memory.
        self._live_values: Mapping[str, Any] = {}
        self._lock = threading.Lock()
        try:
            values: dict[str, Any] | None = agent.parameters()
        except NotTrainable as error:
            self._refusal: NotTrainable | None = error
            first, self._in_place, self._swaps = WeightsVersion(0, digest, None), False, False
        else:
            self._refusal = None
            # An agent with its own `load_parameters` may copy values instead of keeping references
            # to them.
            policy: Any = agent
            while type(policy).load_parameters is Wrapper.load_parameters:
                policy = policy.agent
            own, copied = (
                type(policy).load_parameters is not Agent.load_parameters,
                trainable.is_copied(values or {}),
            )
            self._in_place, self._swaps = (
                own or copied,
                copied and not own and trainable.are_apart(values or {}),
            )
            first = WeightsVersion(
                0, trainable.fingerprint(values or {}), None if self._in_place else values
            )
            if self._in_place:
                self._live_values = values or {}
            self.gpus = readable_gpus(gpu_of(values or {}))
            on_gpu = (
                value.device
                for value in (values or {}).values()
                if getattr(value, "is_cuda", False)
            )
            self._device = next(on_gpu, "cpu")
        self.newest = self.pinned = first
        # Number of the last version with which all following sessions act, since its mode was
        # "keep".
        self.kept = 0
        self._staged: WeightsVersion | None = None
        self._timer: threading.Timer | None = None
        # Version in the agent; None if loading one has failed.
        self._live: WeightsVersion | None = first
        self._alive = WeakValueDictionary({0: first})
        self._asleep = False
        # Memory of the host with the values of the GPU, while it sleeps.
        self._moved: list[tuple[Any, Any]] = []
        # Is increased when another version begins to become the agent's, and when it has: odd in
        # between.
        self._switches = 0

    def begin(self, session: FollowingSession, *, follows: bool) -> WeightsVersion:
        """Choose the newest or the pinned version for the session's next episode, and return it."""
        with self._lock:
            session.follows = follows
            session.weights = self.newest if follows else self.pinned
            return session.weights

    def end(self, session: FollowingSession) -> None:
        """Hold no version for the session any more, since its episode has ended."""
        with self._lock:
            session.weights = None

    def find(self, number: int, digest: str, *, follows: bool = False) -> WeightsVersion:
        """Return the version for a session from another replica, which acts with that number there.

        A session that `follows` the newest version gets a newer one that was pushed since with the
        mode "keep".

        Raises:
            VersionNotHeld: The version is not held here; see `restore`.
        """
        with self._lock:
            if follows and number < self.kept:
                return self._alive.get(self.kept, self.newest)
            version = self._alive.get(number)
        if version is None or version.fingerprint != digest or version is self._staged:
            raise VersionNotHeld(
                f"version {number} of the weights ({digest}) is not held here; reset the session"
            )
        return version

    def restore(self, number: int, digest: str, values: Mapping[str, Any]) -> WeightsVersion:
        """Hold a version again that was freed here, or never pushed to this replica, as long as a
        session uses it.

        Args:
            number: Number of the version.
            digest: Its fingerprint.
            values: Its values, as another replica's `portable_values` returns them.

        Raises:
            VersionNotHeld: The values have another fingerprint.
        """
        restored = self.make(number, self.newest, values, PushOptions(allow_same=True))
        if restored.fingerprint != digest:
            raise VersionNotHeld(
                f"version {number} of the weights: expected values with the fingerprint {digest}, "
                f"got {restored.fingerprint}; reset the session"
            )
        with self._lock:
            return self._alive.setdefault(number, restored)

    def catch_up(self, session: FollowingSession) -> None:
        """Change a session that was not in the table of sessions to the last version pushed with
        the mode "keep".
        """
        with self._lock:
            acts_with = session.weights
            if session.follows and acts_with is not None and acts_with.number < self.kept:
                session.weights = self._alive.get(self.kept, self.newest)

    def use(self, version: WeightsVersion) -> None:
        """Load a version into the agent. Called with `busy` held, on the policy's thread.

        The memory of freed versions stays torch's, for the next push: its return would wait for the
        GPU.
        """
        if version is self._live:
            return
        self._switches += 1
        outgoing, self._live = None if self._live is None else ref(self._live), None
        live = None if outgoing is None else outgoing()  # None if nothing else refers to it
        kept = live if self._in_place and live is not None and live.values is None else None
        with beside_acts(self._device):  # all use of versions' memory is on that stream
            if (
                kept is not None
                and version.values is not None
                and self._swaps
                and not version.on_host
            ):
                trainable.swap(self._agent.parameters(), version.values)
                kept.values = version.values
            else:
                if kept is not None:
                    kept.values = trainable.mapped(trainable.own_copy, self._agent.parameters())
                if version.values is not None:  # otherwise the agent still has its own values
                    self._agent.load_parameters(version.values)
        self._live = version
        if self._in_place:
            version.values, version.on_host = None, False
            if not self._swaps:  # otherwise the parameters are the same objects
                self._live_values = self._agent.parameters()
        self._switches += 1

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check the header of a push, and return the types and shapes of the announced values.

        Args:
            header: The header of a push, as `vlagents_ray.weights.safetensors.header_of` returns
                it.
            options: The options of the push.

        Raises:
            NotTrainable: The agent names no parameters.
            MessageTooLarge: The header is twice as long as one with the agent's own names would be.
                It is not parsed.
            MalformedMessage: The header is invalid.
            InvalidWeights: The values do not fit.
        """
        if self._refusal is not None:
            raise self._refusal
        held = self._held(self.newest)
        # Each entry has its name, a type, numbers of up to 15 digits, and at most 60 further
        # characters of JSON.
        most = 4096 + 2 * sum(len(name) + 90 + 16 * len(held[name].shape) for name in held)
        if len(header) > most:
            raise MessageTooLarge(
                f"weights: expected a header of at most {most} bytes for the policy's {len(held)} "
                f"names, got {len(header)}"
            )
        announced = read_header(header)
        trainable.require_fit(held, announced, partial=options.partial)
        return announced

    def stage(
        self,
        number: int,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
        sessions: Callable[[], Iterable[FollowingSession]] = tuple,
    ) -> str:
        """Check a new version and hold it without using it; return its fingerprint.

        It is dropped unless it is committed within a minute, since its learner may have died.

        Args:
            number: The number of the version, above that of the newest one.
            pushed: Its values, by name.
            options: The options of the push.
            sessions: Returns the sessions of the replica, without a lock.

        Raises:
            NotTrainable: The agent names no parameters.
            Overloaded: Another version is staged, or the number is not above that of the newest
                version.
            InvalidWeights: The values do not fit.
            UnchangedWeights: The values equal those of the newest version.
        """
        if self._refusal is not None:
            raise self._refusal
        placeholder = WeightsVersion(number, "", None)
        with self._lock:
            newest = self.newest
            if number <= newest.number:
                raise Overloaded(
                    f"weights: expected a version above {newest.number}, the newest here, got "
                    f"{number}, as another push was faster; push again"
                )
            if self._staged is not None:
                raise Overloaded("weights: another push is under way; push again when it is over")
            self._staged = placeholder
        try:
            with self._uncaptured():
                if self._swaps:
                    self._move_to_host({session.weights for session in sessions()})
                staged = self.make(number, newest, pushed, options)
        except BaseException:
            self.drop(number)
            raise
        with self._lock:
            if self._staged is not placeholder:
                raise WeightsNotStaged(
                    f"weights: version {number} was dropped while it was checked; push it again"
                )
            self._staged = staged
            self._timer = threading.Timer(STAGED_S, self.drop, (number,))
            self._timer.daemon = True
            self._timer.start()
        return staged.fingerprint

    def make(
        self,
        number: int,
        newest: WeightsVersion,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
    ) -> WeightsVersion:
        """Return a version of pushed values, which have been checked; missing names have the
        values of the newest.
        """
        with (
            self._uncaptured(),
            opened(pushed) if isinstance(pushed, SharedValues) else nullcontext(pushed) as named,
        ):
            new = trainable.accepted(self._held(newest), named, partial=options.partial)

            def completed(held: Mapping[str, Any]) -> dict[str, Any]:
                return trainable.completed(
                    held, new, allow_same=options.allow_same, in_place=self._in_place
                )

            reads_none = options.allow_same and not options.partial
            values = completed(self._held(newest)) if reads_none else self._read(newest, completed)
            return WeightsVersion(number, trainable.fingerprint(values), values)

    def admit(self, version: WeightsVersion) -> None:
        """Let `find` return a version while it is held."""
        self._alive[version.number] = version

    def act_with(self, version: WeightsVersion, sessions: Iterable[FollowingSession]) -> None:
        """Act with a version in all sessions and coming episodes, in a child process, whose
        replica decides on it.
        """
        with self._lock:
            self.newest = self.pinned = version
            for session in sessions:
                if session.weights is not None:
                    session.weights = version

    def commit(
        self, number: int, options: PushOptions, sessions: Callable[[], Iterable[FollowingSession]]
    ) -> None:
        """Use a staged version from now on. A repeated commit of the newest version does nothing.

        Args:
            number: The number of the version.
            options: The options of the push.
            sessions: Returns the sessions of the replica, without a lock.

        Raises:
            WeightsNotStaged: The version is neither staged nor the newest one.
        """
        with self._lock:
            if self.newest.number == number:
                return
            if self._staged is None or self._staged.number != number or self._staged.values is None:
                raise WeightsNotStaged(
                    f"weights: version {number} is not staged here; push it again, and commit "
                    f"within {STAGED_S:g} s"
                )
            self.newest = self._alive[number] = self._staged
            if options.pin:
                self.pinned = self.newest
            self._forget_staged()
            if options.mode == "keep":
                self.kept = number
                for session in sessions():
                    acts_with = session.weights  # of this model, or of another one
                    if (
                        session.follows
                        and acts_with is not None
                        and self._alive.get(acts_with.number) is acts_with
                    ):
                        session.weights = self.newest

    def drop(self, number: int) -> None:
        """Drop a staged version; the last committed one is kept."""
        with self._lock:
            if self._staged is None or self._staged.number != number:
                return
            self._forget_staged()
        if self._in_place:
            with CAPTURES.pushes:
                empty_cache()

    def portable_values(self, version: WeightsVersion) -> dict[str, Any]:
        """Return the values of a version as numpy arrays, for another process."""
        with self._uncaptured():
            values = self._read(version, self._unchanging)
            return {name: trainable.portable(value) for name, value in values.items()}

    def sleep(self, *, offload: bool) -> None:
        """Free the memory that torch has cached and, with `offload`, that of all versions and
        graphs, until `wake`.

        The caller keeps the agent from acting meanwhile.

        Raises:
            NotTrainable: The agent names no parameters, which `offload` would move.
        """
        if offload and self._refusal is not None:
            raise self._refusal
        with CAPTURES.pushes, self._busy:
            if offload:
                self._asleep = True
                self._agent.sleep()
                held = [
                    version.values for version in self._alive.values() if version.values is not None
                ]
                trainable.to_host([self._agent.parameters(), *held], self._moved)
        free_memory()

    def wake(self) -> None:
        """Move the versions back, and make the graphs again; does nothing if the agent is awake.

        Raises:
            PolicyUnavailable: The GPU has too little memory; the agent still sleeps.
        """
        with CAPTURES.pushes, self._busy:
            if not self._asleep:
                return
            try:
                trainable.from_host(self._moved)
                self._agent.wake()
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                raise PolicyUnavailable(
                    "wake: the GPU has too little memory for the policy, which still sleeps; free "
                    "the learner's, "
                    f"with torch.cuda.empty_cache(), and call wake again ({error})"
                ) from error
            self._asleep = False

    @contextmanager
    def _uncaptured(self) -> Iterator[None]:
        """Work on versions beside the acts, but not beside a capture; raises `PolicyUnavailable`
        while they sleep.
        """
        with CAPTURES.pushes:
            if self._asleep:
                raise PolicyUnavailable(
                    "weights: expected a policy that is awake, got one that sleeps; give wake() "
                    "the new values, or call it first"
                )
            with beside_acts(self._device):
                yield

    def _forget_staged(self) -> None:
        self._staged = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _held(self, version: WeightsVersion) -> Mapping[str, Any]:
        """Return references to values with the types, shapes and devices of the version's,
        without waiting for acts.
        """
        values = version.values
        return self._parameters() if values is None or version.on_host else values

    def _parameters(self) -> Mapping[str, Any]:
        """Return the agent's own values. Lazy layers have none before the first act, which has
        their sizes.
        """
        if not self._live_values:
            with self._busy:
                self._live_values = self._agent.parameters()
        return self._live_values

    def _read(self, version: WeightsVersion, read: Callable[[Mapping[str, Any]], T]) -> T:
        """Return the result of a function of a version's values, which may be the agent's.

        It does not wait for acts. If another version becomes the agent's meanwhile, in the same
        memory, the function is called once more, between two acts.
        """

        def result() -> T:
            values = version.values
            return read(self._live_values if values is None else values)

        if version.values is None:
            self._parameters()
        if not self._in_place:
            return result()
        switches = self._switches
        if switches % 2 == 0:
            try:
                found = result()
            except VLAgentsError:
                if self._switches == switches:
                    raise
            else:
                if self._switches == switches:
                    return found
        with self._busy:
            return result()

    def _unchanging(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        return trainable.mapped(trainable.own_copy, values) if self._in_place else values

    def _move_to_host(self, used: set[WeightsVersion | None]) -> None:
        """Move the pinned and the newest version out of the GPU's memory, unless it is the
        agent's or one of `used`.
        """
        for version in {self.pinned, self.newest} - used:
            switches, values = self._switches, version.values
            if values is None or version.on_host:
                continue
            moved = trainable.mapped(trainable.on_host, values)
            with self._busy:
                if self._switches == switches:  # otherwise another version may have got its memory
                    version.values, version.on_host = moved, True


class HoldsWeights(ABC):
    """An agent that holds the versions of its weights itself, such as one in another process."""

    @abstractmethod
    def model_weights(
        self, busy: threading.Lock, digest: str, model: tuple[str, str]
    ) -> ModelWeights:
        """Return the versions; see `ModelWeights` for the arguments."""


@dataclass(frozen=True, slots=True)
class NewestVersion:
    """The newest version of a replica."""

    number: int
    # Equal in replicas that loaded the same checkpoint with the same settings.
    model: tuple[str, str]
    # UUIDs of the GPUs whose memory it can copy: that of its weights, and its peers; none if there
    # is no single GPU
    gpus: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HeldVersion:
    """A pushed version, sent to a replica that lacks it."""

    number: int
    pinned: bool
    kept: int  # number of the replica's last version whose mode was "keep"
    values: dict[str, np.ndarray]  # by name, as returned by `portable`


class OwnWeights(Protocol):
    """The models of a replica, as far as their weights are concerned."""

    @property
    def own_weights(self) -> ModelWeights:
        """The weights of the deployment's own model; raises `PolicyUnavailable` while it loads."""


class AllSessions(Protocol):
    """The sessions of a replica, as far as their weights are concerned."""

    def all(self) -> Sequence[FollowingSession]:
        """Return all sessions, without a lock."""


class WeightUpdates:
    """Stages and commits new weights in one replica. Thread-safe."""

    def __init__(
        self,
        models: OwnWeights,
        sessions: AllSessions,
    ) -> None:
        """Update the weights of a replica.

        Args:
            models: Has the weights of the deployment's own model.
            sessions: The sessions, which act with them.
        """
        self._models, self._sessions = models, sessions
        # Held while the policy's thread runs a batch, and while the policy sleeps.
        self.acting_lock = threading.Lock()
        self._resting = threading.RLock()  # held during each step of a rest
        # Those of the policy that sleeps, for which `acting` is held.
        self._asleep: ModelWeights | None = None
        self._alarm: threading.Timer | None = None
        # In a child process: those that its replica refers to.
        self._given: dict[int, WeightsVersion] = {}

    def own(self) -> ModelWeights:
        """Return the weights; raise `PolicyUnavailable` while the policy loads."""
        return self._models.own_weights

    def stage(
        self, number: int, pushed: Mapping[str, Any] | SharedValues, options: PushOptions
    ) -> str:
        """Check and hold a new version, and return its fingerprint, as `ModelWeights.stage`
        does.
        """
        return self.own().stage(number, pushed, options, self._sessions.all)

    def commit(self, number: int, options: PushOptions) -> None:
        """Use the staged version, as `ModelWeights.commit` does."""
        self.own().commit(number, options, self._sessions.all)

    def held(self) -> list[HeldVersion]:
        """Return the pinned and the newest version, the older one first, except for the
        checkpoint itself.
        """
        own = self.own()
        pinned, newest = own.pinned, own.newest
        pushed = dict.fromkeys(version for version in (pinned, newest) if version.number)
        return [
            HeldVersion(one.number, one is pinned, own.kept, own.portable_values(one))
            for one in pushed
        ]

    def drop(self, number: int) -> None:
        """Drop the staged version."""
        self.own().drop(number)

    def rest(self, rest: Rest) -> None:
        """Make the policy sleep after the running batch, restore its memory, or let it act again.

        Requests wait in the queue meanwhile. "restore" and "wake" do nothing if it is awake.

        Raises:
            PolicyUnavailable: The policy loads, or its GPU has too little memory, so that it still
                sleeps.
            Overloaded: It sleeps already.
            NotTrainable: See `ModelWeights.sleep`.
        """
        own = self.own()
        with self._resting:
            if rest.step == "sleep":
                self._sleep(own, rest)
            elif self._asleep is not None:
                self._asleep.wake()
                if rest.step == "wake":
                    self._asleep = None
                    self.acting_lock.release()
                    if self._alarm is not None:
                        self._alarm.cancel()

    def _sleep(self, own: ModelWeights, rest: Rest) -> None:
        if self._asleep is not None:
            raise Overloaded("sleep: the policy sleeps already; call wake first")
        self.acting_lock.acquire()
        try:
            own.sleep(offload=rest.offload)
        except BaseException:
            try:
                own.wake()
            finally:
                self.acting_lock.release()
            raise
        self._asleep = own
        self._set_alarm(rest.at_most_s)

    def _set_alarm(self, seconds: float) -> None:
        self._alarm = threading.Timer(seconds, self._oversleep, (seconds,))
        self._alarm.daemon = True
        self._alarm.start()

    def _oversleep(self, seconds: float) -> None:
        with self._resting:
            if self._alarm is not threading.current_thread():
                return
            logger.warning(
                "the policy slept for %g s, its limit, and wakes without its learner", seconds
            )
            try:
                self.rest(Rest("wake"))
            except Exception:
                logger.exception("the policy does not wake; tried again in %g s", seconds)
                self._set_alarm(seconds)

    # In a child process: its replica decides which version acts, and when one is dropped. It names
    # version 0 as 0, and others by numbers of its own, as a version may be pushed twice.

    def make(
        self,
        name: int,
        base: int,
        number: int,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
    ) -> str:
        """Make a version from pushed values and those of `base`, and return its fingerprint."""
        own = self.own()
        made = self._given[name] = own.make(number, self.given(base), pushed, options)
        own.admit(made)
        return made.fingerprint

    def given(self, name: int) -> WeightsVersion:
        """Return the version that the replica named so."""
        if not self._given:
            self._given[0] = self.own().newest
        return self._given[name]

    def obey(self, use: int | None = None, forget: int | None = None) -> None:
        """Act with one version from now on, or drop one. Called on the policy's thread, between
        two batches.
        """
        if use is not None:
            self.own().act_with(self.given(use), self._sessions.all())
        if forget is not None:
            self._given.pop(forget, None)

    def acting(self) -> tuple[int, str]:
        """Return number and fingerprint of the version with which all sessions act."""
        newest = self.own().newest
        return newest.number, newest.fingerprint

    def describe(self) -> dict[str, dict[str, Any]] | None:
        """Return number and fingerprint of the newest and the pinned version, for the metadata;
        None while it loads.
        """
        try:
            own = self.own()
        except PolicyUnavailable:
            return None
        return {"newest": own.newest.info[POLICY], "pinned": own.pinned.info[POLICY]}

    def newest(self) -> NewestVersion:
        """Return the newest version; raise `PolicyUnavailable` while the policy loads."""
        own = self.own()
        return NewestVersion(own.newest.number, own.model, own.gpus)

    @property
    def number(self) -> int:
        """Number of the newest version; 0 while the policy loads."""
        try:
            return self.own().newest.number
        except PolicyUnavailable:
            return 0


def follows(options: dict[str, Any], *, by_default: bool) -> bool:
    """Remove the option "weights" from the options of a reset, and return whether the episode uses
    the newest version.

    Raises:
        InvalidInput: The option has another value than "follow" or "pinned".
    """
    wanted = options.pop(OPTION, _FOLLOW if by_default else _PINNED)
    if not isinstance(wanted, str) or wanted not in (_FOLLOW, _PINNED):
        raise InvalidInput(
            f"{OPTION}: expected {_FOLLOW!r} (the newest version) or {_PINNED!r}, got {wanted!r}"
        )
    return bool(wanted == _FOLLOW)
