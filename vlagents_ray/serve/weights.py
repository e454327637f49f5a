"""The versions of one model's weights, and the version with which each session acts.

Version 0 is the loaded checkpoint. A push stages a version, which is checked and stored but not
used, and commits it when all replicas have it. A part of the replica coordinates the push
(`serve.replica`). A commit copies and loads nothing: before a batch, a reset or an observation, the
policy's thread loads the sessions' version into the agent (`ModelWeights.use`), which takes no time
if the agent already has it. A version is freed when no session acts with it, unless it is the
newest or the pinned version.

On a GPU, the version in use is stored in the agent's parameters, and loading another version
replaces it. The GPU's memory holds at most two versions: the version in use and a staged version.
Versions with which no session acts are moved to the memory of the host.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, Protocol, TypeVar, get_args
from weakref import WeakValueDictionary, ref

import numpy as np

from vlagents_ray.abilities import Sleeps, Trainable, ability
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
from vlagents_ray.interface import POLICY, Agent, TrainableAgent
from vlagents_ray.policies.base.accelerator import empty_cache, free_memory, is_out_of_memory
from vlagents_ray.policies.compilation import CAPTURES
from vlagents_ray.policies.wrapper import require_trainable
from vlagents_ray.weights import trainable
from vlagents_ray.weights.moved_arrays import MovedArrays
from vlagents_ray.weights.safetensors import ValueSpec, read_header
from vlagents_ray.weights.shared_values import SharedValues, gpu_of, opened, readable_gpus
from vlagents_ray.weights.trainable import beside_acts

logger = logging.getLogger(__name__)

T = TypeVar("T")

STAGED_S = 60.0  # time for which a staged version waits for its commit, s

PushMode = Literal["keep", "next_episode"]
"""When a session changes to a new version: between two of its acts, or at its next reset."""
RestStep = Literal["sleep", "restore", "wake"]
"""The steps of a rest. "sleep": the policy stops acting, and frees memory. "restore": the memory is
restored, but the policy does not act yet. "wake": the policy acts again.
"""
OPTION = "weights"  # option of a reset
_LARGEST = 2**53 - 1  # largest version number, which JSON represents exactly
_LONGEST_REST_S = 86_400.0
_FOLLOW, _PINNED = "follow", "pinned"
_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class PushOptions:
    """The options of a push."""

    mode: PushMode = "next_episode"  # when sessions change to the new weights
    partial: bool = False  # whether names may be missing; the missing values are then kept
    allow_same: bool = False  # whether all values may be equal to the values of the newest version
    # Whether the version is also used by sessions that do not follow the newest version, from their
    # next reset.
    pin: bool = False
    # The number of the version, such as the training step; by default, one above the newest
    # version.
    version: int | None = None

    def __post_init__(self) -> None:
        if self.version is not None and not 1 <= self.version <= _LARGEST:
            raise InvalidInput(f"version: expected a number in [1, {_LARGEST}], got {self.version}")
        if self.mode not in get_args(PushMode):
            raise InvalidInput(
                f"mode: expected one of {list(get_args(PushMode))}, got {self.mode!r}"
            )


class VersionNotHeld(UnknownSession):
    """Raised if a session acts with a version of the weights that the replica does not have."""


class WeightsVersion:
    """One version of a model's weights."""

    __slots__ = ("__weakref__", "fingerprint", "info", "number", "on_host", "values")

    def __init__(self, number: int, digest: str, values: dict[str, Any] | None) -> None:
        self.number = number
        self.fingerprint = digest
        self.values = values  # values by name; None if only the agent has the values
        self.on_host = False  # whether the values were moved out of the GPU's memory
        self.info = {POLICY: {"version": number, "fingerprint": digest}}  # for the info of each act


@dataclass(frozen=True, slots=True)
class Rest:
    """A step of the sleep of a policy, during which it does not act."""

    step: RestStep
    # Whether "sleep" moves weights to the memory of the host, and frees CUDA graphs.
    offload: bool = True
    # Time after which a replica wakes without its learner, which may have died, s.
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

    weights: WeightsVersion | None  # version with which the session acts; None without an episode
    # Whether the session uses the newest version; otherwise it uses the pinned version.
    follows: bool


class ModelWeights:
    """The versions of one model. Thread-safe, except `use`, which runs on the policy's thread."""

    def __init__(
        self,
        agent: Agent,
        busy: threading.Lock,
        digest: str = "",
        model: tuple[str, str] = ("", ""),
    ) -> None:
        """Create the versions of an initialized agent, whose current weights are version 0.

        Args:
            agent: The agent, which uses one version at a time.
            busy: The lock that is held while the agent runs.
            digest: The fingerprint of an agent that declares no parameters.
            model: A value that is equal in replicas with the same checkpoint and settings.
        """
        self.model = model
        self.gpus: tuple[str, ...] = ()  # see `NewestVersion`
        self._busy = busy
        self._device: Any = "cpu"  # GPU of the agent's values; None if they are not on a GPU
        # The agent's own values, if other versions are loaded into the same memory.
        self._live_values: Mapping[str, Any] = {}
        self._lock = threading.Lock()
        self._sleeps = ability(agent, Sleeps)
        # None if the policy declares no parameters.
        self._trainable: Trainable | None = None
        try:
            trained = require_trainable(agent)
            values: dict[str, Any] | None = trained.parameters()
        except NotTrainable as error:
            self._refusal: NotTrainable | None = error
            first, self._in_place, self._swaps = WeightsVersion(0, digest, None), False, False
        else:
            self._refusal = None
            self._trainable = trained
            # An agent with its own `load_parameters` may copy values instead of keeping references
            # to them.
            loads_itself = type(trained).load_parameters is not TrainableAgent.load_parameters
            is_copied = trainable.is_copied(values or {})
            self._in_place = loads_itself or is_copied
            self._swaps = is_copied and not loads_itself and trainable.are_apart(values or {})
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
        # Number of the last version with the mode "keep", with which all following sessions act.
        self.kept = 0
        self._staged: WeightsVersion | None = None
        self._timer: threading.Timer | None = None
        # Version in the agent; None if loading a version has failed.
        self._live: WeightsVersion | None = first
        self._alive = WeakValueDictionary({0: first})
        self._asleep = False
        # Copies of the values on the GPU in the memory of the host, while the policy sleeps.
        self._moved: list[tuple[Any, Any]] = []
        self._moved_arrays = MovedArrays()
        # A counter that is increased before and after another version is loaded into the agent, so
        # it is odd during the load.
        self._switches = 0

    def begin(self, session: FollowingSession, *, follows: bool) -> WeightsVersion:
        """Choose the newest or the pinned version for the session's next episode, and return the
        version.
        """
        with self._lock:
            session.follows = follows
            session.weights = self.newest if follows else self.pinned
            return session.weights

    def end(self, session: FollowingSession) -> None:
        """Release the session's version, since its episode has ended."""
        with self._lock:
            session.weights = None

    def find(self, number: int, digest: str, *, follows: bool = False) -> WeightsVersion:
        """Return the version for a session from another replica, where it acts with the version
        `number`. A session that `follows` the newest version gets a newer version if one was pushed
        since with the mode "keep".

        Raises:
            VersionNotHeld: This replica does not have the version; see `restore`.
        """
        with self._lock:
            if follows and number < self.kept:
                return self._alive.get(self.kept, self.newest)
            version = self._alive.get(number)
        if version is None or version.fingerprint != digest or version is self._staged:
            raise VersionNotHeld(
                f"version {number} of the weights ({digest}) does not exist at this replica; reset "
                "the session"
            )
        return version

    def restore(self, number: int, digest: str, values: Mapping[str, Any]) -> WeightsVersion:
        """Add a version that was freed, or never pushed to this replica. It is kept as long as a
        session uses it.

        Args:
            number: Number of the version.
            digest: The fingerprint of the version.
            values: The values of the version, as another replica's `portable_values` returns them.

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
        """Change a session to the last version that was pushed with the mode "keep", if the session
        was not in the table of sessions at the time of the push.
        """
        with self._lock:
            acts_with = session.weights
            if session.follows and acts_with is not None and acts_with.number < self.kept:
                session.weights = self._alive.get(self.kept, self.newest)

    def use(self, version: WeightsVersion) -> None:
        """Load a version into the agent. Called with `busy` held, on the policy's thread.

        The memory of freed versions is not returned but stays in torch's cache for the next push,
        since returning it would wait for the GPU.
        """
        if version is self._live:
            return
        self._switches += 1
        outgoing, self._live = None if self._live is None else ref(self._live), None
        # None if nothing else refers to the version.
        live = None if outgoing is None else outgoing()
        kept = live if self._in_place and live is not None and live.values is None else None
        # All work on the memory of versions uses this stream, which waits here for earlier acts.
        with beside_acts(self._device):
            if (
                kept is not None
                and version.values is not None
                and self._swaps
                and not version.on_host
            ):
                trainable.swap(self._own_values(), version.values)
                kept.values = version.values
            else:
                if kept is not None:
                    kept.values = trainable.own_copies(self._own_values())
                # For a version without stored values, the agent still has its own values.
                if version.values is not None and self._trainable is not None:
                    self._trainable.load_parameters(version.values)
        self._live = version
        if self._in_place:
            version.values, version.on_host = None, False
            if not self._swaps:  # a swap keeps the parameter objects
                self._live_values = self._own_values()
        self._switches += 1

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check the header of a push, and return the types and shapes of the announced values.

        Args:
            header: The header of a push, as `vlagents_ray.weights.safetensors.header_of` returns
                it.
            options: The options of the push.

        Raises:
            NotTrainable: The agent declares no parameters.
            MessageTooLarge: The header is more than twice as long as a header with the agent's own
                names would be. It is not parsed.
            MalformedMessage: The header is invalid.
            InvalidWeights: The values do not fit.
        """
        if self._refusal is not None:
            raise self._refusal
        layout = self._layout(self.newest)
        # Each entry has its name, a type, numbers of up to 15 digits, and at most 60 further
        # characters of JSON.
        most = 4096 + 2 * sum(len(name) + 90 + 16 * len(layout[name].shape) for name in layout)
        if len(header) > most:
            raise MessageTooLarge(
                f"weights: expected a header of at most {most} bytes for the policy's "
                f"{len(layout)} names, got {len(header)}"
            )
        announced = read_header(header)
        trainable.require_fit(layout, announced, partial=options.partial)
        return announced

    def stage(
        self,
        number: int,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
        sessions: Callable[[], Iterable[FollowingSession]] = tuple,
    ) -> str:
        """Check and store a new version without using it; return its fingerprint.

        The version is dropped unless it is committed within a minute, since its learner may have
        died.

        Args:
            number: The number of the version, above the number of the newest version.
            pushed: The values of the version, by name.
            options: The options of the push.
            sessions: Returns the sessions of the replica, without a lock.

        Raises:
            NotTrainable: The agent declares no parameters.
            Overloaded: Another version is staged, or the number is not above the number of the
                newest version.
            InvalidWeights: The values do not fit.
            UnchangedWeights: The values are equal to the values of the newest version.
        """
        if self._refusal is not None:
            raise self._refusal
        placeholder = WeightsVersion(number, "", None)
        with self._lock:
            newest = self.newest
            if number <= newest.number:
                raise Overloaded(
                    f"weights: expected a version above {newest.number}, the newest here, got "
                    f"{number}, since another push was faster; push again"
                )
            if self._staged is not None:
                raise Overloaded(
                    "weights: another push is in progress; push again when it has ended"
                )
            self._staged = placeholder
        try:
            with self._uncaptured(pushed):
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
        """Return a version of pushed values, which have been checked. Missing names have the values
        of the newest version.
        """
        with (
            self._uncaptured(pushed),
            opened(pushed) if isinstance(pushed, SharedValues) else nullcontext(pushed) as named,
        ):
            new = trainable.accepted(self._layout(newest), named, partial=options.partial)

            def completed(current: Mapping[str, Any]) -> dict[str, Any]:
                return trainable.completed(
                    current, new, allow_same=options.allow_same, in_place=self._in_place
                )

            reads_none = options.allow_same and not options.partial
            values = (
                completed(self._layout(newest)) if reads_none else self._read(newest, completed)
            )
            return WeightsVersion(number, trainable.fingerprint(values), values)

    def register(self, version: WeightsVersion) -> None:
        """Make a version available to `find` as long as it is in use."""
        self._alive[version.number] = version

    def act_with(self, version: WeightsVersion, sessions: Iterable[FollowingSession]) -> None:
        """Act with a version in all sessions and later episodes. This method is called in a child
        process, whose replica chooses the version.
        """
        with self._lock:
            self.newest = self.pinned = version
            for session in sessions:
                if session.weights is not None:
                    session.weights = version

    def commit(
        self, number: int, options: PushOptions, sessions: Callable[[], Iterable[FollowingSession]]
    ) -> None:
        """Use a staged version. A repeated commit of the newest version does nothing.

        Args:
            number: The number of the version.
            options: The options of the push.
            sessions: Returns the sessions of the replica, without a lock.

        Raises:
            WeightsNotStaged: The version is neither staged nor the newest version.
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
                    acts_with = session.weights  # weights of this model, or of another model
                    if (
                        session.follows
                        and acts_with is not None
                        and self._alive.get(acts_with.number) is acts_with
                    ):
                        session.weights = self.newest

    def drop(self, number: int) -> None:
        """Drop a staged version; the last committed version is kept."""
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
        """Free the memory in torch's cache until `wake`. With `offload`, also free the memory of
        all versions and graphs.

        The caller must prevent the agent from acting until then.

        Raises:
            NotTrainable: The agent declares no parameters that `offload` could move.
        """
        if offload and self._refusal is not None:
            raise self._refusal
        with CAPTURES.pushes, self._busy, beside_acts(self._device):
            if offload:
                self._asleep = True
                if self._sleeps is not None:
                    self._sleeps.sleep()
                values = [
                    version.values for version in self._alive.values() if version.values is not None
                ]
                trainable.to_host([self._own_values(), *values], self._moved)
                self._arrays_to_host()
        free_memory()

    def wake(self) -> None:
        """Move the versions back, and capture the graphs again; does nothing if the agent is awake.

        Raises:
            PolicyUnavailable: The GPU has too little memory; the agent still sleeps.
        """
        with CAPTURES.pushes, self._busy, beside_acts(self._device):
            if not self._asleep:
                return
            try:
                trainable.from_host(self._moved)
                self._arrays_from_host()
                if self._sleeps is not None:
                    self._sleeps.wake()
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
                raise PolicyUnavailable(
                    "wake: the GPU has too little memory for the policy, which still sleeps; free "
                    "the learner's memory with torch.cuda.empty_cache(), and call wake again "
                    f"({error})"
                ) from error
            self._asleep = False

    def _arrays_to_host(self) -> None:
        """Move JAX arrays to the host, if the agent keeps only references to them."""
        if self._in_place or self._trainable is None:
            return
        for version in list(self._alive.values()):
            if version.values is not None:
                version.values = self._moved_arrays.to_host(version.values)
        own_values = self._moved_arrays.to_host(self._own_values())
        if not self._moved_arrays.is_empty:
            self._trainable.load_parameters(own_values)

    def _arrays_from_host(self) -> None:
        """Move JAX arrays back to their devices."""
        if self._moved_arrays.is_empty or self._trainable is None:
            return
        for version in list(self._alive.values()):
            if version.values is not None:
                self._moved_arrays.from_host(version.values)

        own_values = self._own_values()
        try:
            self._moved_arrays.from_host(own_values)
        finally:
            self._trainable.load_parameters(own_values)
        self._moved_arrays.clear()

    @contextmanager
    def _uncaptured(self, pushed: Mapping[str, Any] | SharedValues = _NOTHING) -> Iterator[None]:
        """Return a context manager for work on versions, which may run during acts, but not during
        the capture of a CUDA graph.

        The work need not wait for acts: they only read the agent's values, and `use` has waited for
        the acts that read the memory of a freed version.

        Args:
            pushed: The pushed values. The GPU may still be computing values of this process;
                another process has waited before it sent its values.

        Raises:
            PolicyUnavailable: The policy sleeps.
        """
        with CAPTURES.pushes:
            if self._asleep:
                raise PolicyUnavailable(
                    "weights: expected a policy that is awake, got one that sleeps; pass the new "
                    "values to wake(), or call wake() first"
                )
            is_computed = isinstance(pushed, SharedValues) or not trainable.has_gpu_tensors(pushed)
            with beside_acts(self._device, waits=not is_computed):
                yield

    def _own_values(self) -> dict[str, Any]:
        """Return references to the agent's values, by name; empty if it declares no parameters."""
        return {} if self._trainable is None else self._trainable.parameters()

    def _forget_staged(self) -> None:
        self._staged = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _layout(self, version: WeightsVersion) -> Mapping[str, Any]:
        """Return references to values that have the types, shapes and devices of the version's
        values, without waiting for acts.
        """
        values = version.values
        return self._parameters() if values is None or version.on_host else values

    def _parameters(self) -> Mapping[str, Any]:
        """Return the agent's values. Lazy layers have no values before the first act, which sets
        their sizes.
        """
        if not self._live_values:
            with self._busy:
                self._live_values = self._own_values()
        return self._live_values

    def _read(self, version: WeightsVersion, read: Callable[[Mapping[str, Any]], T]) -> T:
        """Return the result of a function of a version's values, which may be the agent's own
        values. The method does not wait for acts. If another version is loaded into the same memory
        meanwhile, the function is called once more, between two acts.
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
                value = result()
            except VLAgentsError:
                if self._switches == switches:
                    raise
            else:
                if self._switches == switches:
                    return value
        with self._busy:
            return result()

    def _unchanging(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        return trainable.own_copies(values) if self._in_place else values

    def _move_to_host(self, used: set[WeightsVersion | None]) -> None:
        """Move the pinned and the newest version out of the GPU's memory, except versions in the
        agent or in `used`.
        """
        for version in {self.pinned, self.newest} - used:
            switches, values = self._switches, version.values
            if values is None or version.on_host:
                continue
            moved = trainable.mapped(trainable.on_host, values)
            with self._busy:
                # Otherwise another version may already use its memory.
                if self._switches == switches:
                    version.values, version.on_host = moved, True


class HoldsWeights(ABC):
    """An agent that manages the versions of its weights itself, for example in another process."""

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
    # UUIDs of the GPUs whose memory the replica can copy: the GPU of its weights and the peers of
    # that GPU; empty if the weights are not on a single GPU
    gpus: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HeldVersion:
    """A pushed version in the form in which it is sent to a replica that lacks it."""

    number: int
    pinned: bool
    kept: int  # number of the replica's last version whose mode was "keep"
    values: dict[str, np.ndarray]  # values by name, as returned by `portable`


class OwnWeights(Protocol):
    """The part of `ServedModel` that concerns weights."""

    @property
    def own_weights(self) -> ModelWeights:
        """The weights of the loaded model; raises `PolicyUnavailable` while it loads."""


class AllSessions(Protocol):
    """The part of `SessionTable` that concerns weights."""

    def all(self) -> Sequence[FollowingSession]:
        """Return all sessions, without a lock."""


class WeightUpdates:
    """Stages and commits new weights in one replica. Thread-safe."""

    def __init__(
        self,
        model: OwnWeights,
        sessions: AllSessions,
    ) -> None:
        """Update the weights of a replica.

        Args:
            model: Contains the weights of the loaded model.
            sessions: The sessions that use these weights.
        """
        self._model, self._sessions = model, sessions
        # Held while the policy's thread runs a batch, and while the policy sleeps.
        self.acting_lock = threading.Lock()
        self._resting = threading.RLock()  # held during each step of a rest
        # The weights of the sleeping policy; `acting_lock` is held while it sleeps.
        self._asleep: ModelWeights | None = None
        self._alarm: threading.Timer | None = None
        # In a child process: the versions to which the replica refers, by their names.
        self._by_name: dict[int, WeightsVersion] = {}

    def current(self) -> ModelWeights:
        """Return the weights; raise `PolicyUnavailable` while the policy loads."""
        return self._model.own_weights

    def stage(
        self, number: int, pushed: Mapping[str, Any] | SharedValues, options: PushOptions
    ) -> str:
        """Check and store a new version, and return its fingerprint, as `ModelWeights.stage`
        does.
        """
        return self.current().stage(number, pushed, options, self._sessions.all)

    def commit(self, number: int, options: PushOptions) -> None:
        """Use the staged version, as `ModelWeights.commit` does."""
        self.current().commit(number, options, self._sessions.all)

    def pushed_versions(self) -> list[HeldVersion]:
        """Return the pinned and the newest version, in ascending order, without versions that were
        not pushed.
        """
        weights = self.current()
        pinned, newest = weights.pinned, weights.newest
        pushed = dict.fromkeys(version for version in (pinned, newest) if version.number)
        versions = []
        for version in pushed:
            values = weights.portable_values(version)
            versions.append(HeldVersion(version.number, version is pinned, weights.kept, values))
        return versions

    def drop(self, number: int) -> None:
        """Drop the staged version."""
        self.current().drop(number)

    def rest(self, rest: Rest) -> None:
        """Make the policy sleep after the running batch, restore its memory, or let it act again.

        Requests wait in the queue meanwhile. "restore" and "wake" do nothing if the policy is
        awake.

        Raises:
            PolicyUnavailable: The policy loads, or its GPU has too little memory, so that it still
                sleeps.
            Overloaded: The policy already sleeps.
            NotTrainable: See `ModelWeights.sleep`.
        """
        weights = self.current()
        with self._resting:
            if rest.step == "sleep":
                self._sleep(weights, rest)
            elif self._asleep is not None:
                self._asleep.wake()
                if rest.step == "wake":
                    self._asleep = None
                    self.acting_lock.release()
                    if self._alarm is not None:
                        self._alarm.cancel()

    def _sleep(self, weights: ModelWeights, rest: Rest) -> None:
        if self._asleep is not None:
            raise Overloaded("sleep: the policy is already asleep; call wake first")
        self.acting_lock.acquire()
        try:
            weights.sleep(offload=rest.offload)
        except BaseException:
            try:
                weights.wake()
            finally:
                self.acting_lock.release()
            raise
        self._asleep = weights
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
                logger.exception("the policy does not wake; the next attempt is in %g s", seconds)
                self._set_alarm(seconds)

    # The following methods run in a child process. Its replica decides which version is used, and
    # when a version is dropped. The replica gives version 0 the name 0, and other versions
    # consecutive numbers as names, since a version may be pushed twice.

    def make(
        self,
        name: int,
        base: int,
        number: int,
        pushed: Mapping[str, Any] | SharedValues,
        options: PushOptions,
    ) -> str:
        """Make a version from pushed values and the values of `base`, and return its
        fingerprint.
        """
        weights = self.current()
        version = weights.make(number, self.version_named(base), pushed, options)
        self._by_name[name] = version
        weights.register(version)
        return version.fingerprint

    def version_named(self, name: int) -> WeightsVersion:
        """Return the version to which the replica has given this name."""
        if not self._by_name:
            self._by_name[0] = self.current().newest
        return self._by_name[name]

    def obey(self, use: int | None = None, forget: int | None = None) -> None:
        """Change to a version, or drop a version. This method is called on the policy's thread,
        between two batches.
        """
        if use is not None:
            self.current().act_with(self.version_named(use), self._sessions.all())
        if forget is not None:
            self._by_name.pop(forget, None)

    def acting(self) -> tuple[int, str]:
        """Return the number and the fingerprint of the version with which all sessions act."""
        newest = self.current().newest
        return newest.number, newest.fingerprint

    def describe(self) -> dict[str, dict[str, Any]] | None:
        """Return the number and the fingerprint of the newest and the pinned version, for the
        metadata; None while the policy loads.
        """
        try:
            weights = self.current()
        except PolicyUnavailable:
            return None
        return {"newest": weights.newest.info[POLICY], "pinned": weights.pinned.info[POLICY]}

    def newest(self) -> NewestVersion:
        """Return the newest version; raise `PolicyUnavailable` while the policy loads."""
        weights = self.current()
        return NewestVersion(weights.newest.number, weights.model, weights.gpus)

    @property
    def number(self) -> int:
        """Number of the newest version; 0 while the policy loads."""
        try:
            return self.current().newest.number
        except PolicyUnavailable:
            return 0


def follows(options: dict[str, Any], *, by_default: bool) -> bool:
    """Remove the option "weights" from the options of a reset, and return whether the episode uses
    the newest version.

    Raises:
        InvalidInput: The option has a value other than "follow" or "pinned".
    """
    choice = options.pop(OPTION, _FOLLOW if by_default else _PINNED)
    if not isinstance(choice, str) or choice not in (_FOLLOW, _PINNED):
        raise InvalidInput(
            f"{OPTION}: expected {_FOLLOW!r} (the newest version) or {_PINNED!r}, got {choice!r}"
        )
    return bool(choice == _FOLLOW)
