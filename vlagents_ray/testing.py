"""Test suites for policies and environments. All policies and environments of this package pass
them, and you can use them for your own.

    from vlagents_ray.testing import check_agent, check_env

    def test_my_env_keeps_its_contract():
        check_env(MyEnv())

    def test_my_policy_keeps_its_contract():
        check_agent(MyPolicy())

Each function raises `ContractViolation` with the first violation that it finds, and closes the
agent or environment.
"""

from __future__ import annotations

import copy
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import cycle, islice
from typing import Any

import numpy as np

from vlagents_ray.abilities import Prepares, Sleeps, Trainable, ability, members
from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, kind_of
from vlagents_ray.errors import (
    ConfigError,
    InvalidAction,
    InvalidObservation,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.validation import check_action, check_observation, check_reset

__all__ = ["ContractViolation", "check_agent", "check_env"]

_SCALARS = (bool, int, float, str, bytes)
_SIDE = 64  # px; height and width of a random image if the contract has no size
_DIM = 7  # length of a part of the state if the contract has no size
_SESSIONS = 3
_THREADS = 4  # number of threads that prepare observations in a server
_ROUNDS = 20  # calls of `act` concurrent with these threads, each after `_RESETS` resets
_RESETS = 15  # many resets, since a reset is short and rarely coincides with a call of `prepare`
# Time after which no further call of `act` begins, as the other threads slow it down.
_LONGEST_S = 5.0
_SWITCH_S = 1e-5  # Python's thread switch interval, s, short so that threads interleave more often


class ContractViolation(VLAgentsError):
    """A policy or an environment does not implement its interface; the message names the method or
    value.
    """


def require_wireable(value: object, where: str) -> None:
    """Raise `ContractViolation` unless `value` can be sent in a message."""
    if value is None or type(value) in _SCALARS:
        return
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ContractViolation(
                f"{where}: expected numbers or bools, got an array of {value.dtype}"
            )
    elif isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ContractViolation(f"{where}: expected keys that are str, got {key!r}")
            require_wireable(item, f"{where}[{key!r}]")
    elif isinstance(value, list):
        for i, item in enumerate(value):
            require_wireable(item, f"{where}[{i}]")
    else:
        raise ContractViolation(
            f"{where}: expected None, bool, int, float, str, bytes, numpy arrays, lists and dicts "
            f"of them, got {type(value).__module__}.{type(value).__qualname__}, which a message "
            "cannot carry"
        )


def difference(a: object, b: object, where: str, atol: float = 0.0) -> str | None:
    """Describe the first difference between two values.

    Returns:
        The description; None if the values are equal.
    """
    if a is b:
        return None

    a, b = _plain(a), _plain(b)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return _array_difference(a, b, where, atol)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if a.keys() != b.keys():
            return f"{where} has {sorted(a)} once and {sorted(b)} the other time"
        return _first_difference([(a[key], b[key], f"{where}[{key!r}]") for key in a], atol)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        if len(a) != len(b):
            return f"{where} has {len(a)} items once and {len(b)} the other time"
        items = [(a[i], b[i], f"{where}[{i}]") for i in range(len(a))]
        return _first_difference(items, atol)
    if type(a) is type(b) and a == b:
        return None
    return f"{where} is {a!r} once and {b!r} the other time"


def _first_difference(items: Iterable[tuple[Any, Any, str]], atol: float) -> str | None:
    """Describe the first difference between the items of two values, which are given with their
    paths.
    """
    for a, b, where in items:
        description = difference(a, b, where, atol)
        if description:
            return description
    return None


def _plain(value: object) -> object:
    """Convert tensors and images to arrays, and objects that have attributes but no equality to
    dictionaries.
    """
    if isinstance(value, Act):  # without `info`, which may contain times
        return {"action": value.action, "done": value.done}
    if isinstance(value, Obs):
        return {name: getattr(value, name) for name in ("cameras", "gripper", "state", "info")}
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    if hasattr(value, "__array__") and not isinstance(value, (np.ndarray, np.generic)):
        if "bfloat16" in str(getattr(value, "dtype", "")):  # NumPy has no bfloat16
            value = value.float()  # type: ignore[attr-defined]
        return np.asarray(value)
    if type(value).__eq__ is object.__eq__ and hasattr(value, "__dict__"):
        return vars(value)
    return value


def _array_difference(a: np.ndarray, b: np.ndarray, where: str, atol: float) -> str | None:
    if a.shape != b.shape or a.dtype != b.dtype:
        return f"{where} is {a.shape} {a.dtype} once and {b.shape} {b.dtype} the other time"
    if np.array_equal(a, b, equal_nan=a.dtype.kind == "f"):
        return None
    off = np.abs(a.astype(np.float64) - b.astype(np.float64))
    if off.max() <= atol:
        return None
    return (
        f"{where} differs in {np.count_nonzero(off > atol)} of {a.size} numbers, by up to "
        f"{off.max():.4g}"
    )


def require_same(a: Any, b: Any, where: str, because: str, atol: float = 0.0) -> None:
    """Raise `ContractViolation` unless two values are equal; the message contains the difference
    and the reason `because`.
    """
    description = difference(a, b, where, atol)
    if description:
        raise ContractViolation(f"{description}; {because}")


def check_close(made: Agent | EvalEnv) -> None:
    """Close an agent or an environment twice, which must be safe."""
    for attempt in ("first", "second"):
        try:
            made.close()
        except Exception as error:
            raise ContractViolation(
                f"close: the {attempt} call raised {error!r}; it must be safe to call twice"
            ) from error


def check_agent(
    agent: Agent,
    *,
    obs: Obs | Sequence[Obs] | None = None,
    instructions: Sequence[str] = ("pick up the cube", "push the cube", "open the drawer"),
    reset_kwargs: Mapping[str, Any] | None = None,
    steps: int = 3,
    atol: float = 1e-5,
) -> None:
    """Check that an agent implements the interface of `Agent`; initializes and closes the agent.

    Three sessions, which are copies of the initialized agent, each receive an observation, an
    instruction and a seed. They run in sequence, interleaved, with a move to another replica after
    each step, with prepared observations, and in batches of 1, 2 and 3. The actions of a session
    must not depend on the other sessions, nor on moves, nor on whether `prepare` was called. If the
    agent defines `prepare`, several threads call it while others call `reset` and `act`, as in a
    server, and every result must equal that of a single thread.

    Args:
        agent: The agent, not initialized yet.
        obs: The observations of the sessions, in turn; by default random values that fit the
            contract.
        instructions: The instructions of the sessions, in turn; pass valid ones if the policy
            parses them.
        reset_kwargs: Further arguments of each `reset`, besides `seed`.
        steps: The number of calls of `act` in a session.
        atol: The largest difference between an action in a batch and the same action of a single
            session.

    Raises:
        ContractViolation: The agent does not implement the interface; the message names the method
            or value.
    """
    if not isinstance(agent, Agent):
        raise ContractViolation(
            "agent: expected an object of a class that derives from vlagents_ray.Agent, got "
            f"{agent!r}"
        )

    try:
        check_reset(agent)
    except ConfigError as error:
        raise ContractViolation(str(error)) from error
    agent.initialize()
    contract = agent.contract
    if contract is not None and not isinstance(contract, Contract):
        raise ContractViolation(
            f"contract: expected a Contract or None, got {type(contract).__name__}"
        )

    views = [obs] if isinstance(obs, Obs) else list(obs or ())
    views = views or [random_observation(contract, seed) for seed in range(_SESSIONS)]
    suite = _AgentSuite(
        agent,
        contract,
        list(islice(cycle(views), _SESSIONS)),
        list(islice(cycle(instructions), _SESSIONS)),
        dict(reset_kwargs or {}),
    )

    # Run each session alone.
    alone = [suite.play_alone(i, steps) for i in range(_SESSIONS)]
    because = "the same observations, instruction and seed must give the same actions"
    for i, again in enumerate([suite.play_alone(i, steps) for i in range(_SESSIONS)]):
        require_same(alone[i], again, f"act of session {i}", because)

    # Run all sessions interleaved.
    because = (
        "it depends on other sessions: keep what belongs to an episode in self, and out of `shared`"
    )
    sessions = [suite.begin(i) for i in range(_SESSIONS)]
    for step in range(steps):
        for i, session in enumerate(sessions):
            require_same(
                alone[i][step], suite.act(i, session), f"act {step} of session {i}", because
            )

    _check_moves(suite, alone)
    for protocol in (Trainable, Sleeps):
        _require_whole(agent, protocol)

    if ability(agent, Prepares) is not None:
        _check_prepared(suite, alone)
    _check_batches(suite, alone, atol)
    check_close(agent)


def _check_moves(suite: _AgentSuite, alone: Sequence[Sequence[Act]]) -> None:
    """Move each session to another replica after each step; it must act as without moves.

    After a move, `act` may raise `UnknownSession`, if the state of the episode is not in this
    process, but in a connection to another server. The client then begins again.
    """
    because = (
        "a session that moves to another replica must continue there: keep the state of an episode "
        "in attributes that can be pickled"
    )
    copies = suite.copies()
    for i in range(_SESSIONS):
        session = suite.reset(i, copies.make())
        for step, act in enumerate(alone[i]):
            try:
                again = suite.act(i, session)
            except ContractViolation as error:
                if step and isinstance(error.__cause__, UnknownSession):
                    return
                raise
            require_same(act, again, f"act {step} of session {i} after a move", because)
            session = _moved(session, copies)


def _moved(session: Agent, copies: AgentCopies) -> Agent:
    """Return the session as another replica of the policy receives it."""
    try:
        return copies.load(copies.dump(session))
    except Exception as error:
        raise ContractViolation(
            f"the session cannot be pickled in the middle of its episode: {error!r}; then it "
            "restarts when its replica stops, instead of moving to another one. Create what cannot "
            "be pickled in `initialize` and name it in `shared`, or leave it out in __getstate__"
        ) from error


def _require_whole(agent: Agent, protocol: type) -> None:
    """Raise `ContractViolation` if an agent has only some methods of an ability; a server would use
    none of them.
    """
    missing = [name for name in members(protocol) if getattr(agent, name, None) is None]
    if missing and len(missing) < len(members(protocol)):
        raise ContractViolation(
            f"{type(agent).__name__}: expected all of {list(members(protocol))}, the methods of "
            f"{protocol.__name__}, got none named {missing}; define both, or neither"
        )


def _check_prepared(suite: _AgentSuite, alone: Sequence[Sequence[Act]]) -> None:
    """Run the sessions with prepared observations, also from several threads."""
    because = "`act` must compute the same with and without `prepare`"
    for i, session in enumerate([suite.begin(i) for i in range(_SESSIONS)]):
        for step, act in enumerate(alone[i]):
            where = f"act {step} of session {i} on a prepared observation"
            require_same(act, suite.act(i, session, prepared=True), where, because)
    _check_threads(suite, [acts[0] for acts in alone])


def _check_batches(suite: _AgentSuite, alone: Sequence[Sequence[Act]], atol: float) -> None:
    """Run the sessions in batches of each size."""
    because = "act_batch must return the action that act returns for the session alone"
    for size in range(1, _SESSIONS + 1):
        batch = [suite.begin(i) for i in range(size)]
        for step in range(len(alone[0])):
            for i, act in enumerate(suite.act_batch(batch)):
                where = f"act {step} of session {i} in a batch of {size}"
                require_same(alone[i][step], act, where, because, atol)


def _check_threads(suite: _AgentSuite, first: list[Act]) -> None:
    """Check that threads can prepare observations during calls of `reset` and `act`, whose results
    must equal `first`.
    """
    sessions = [suite.begin(i) for i in range(_SESSIONS)]
    serial = [suite.prepare(i, session) for i, session in enumerate(sessions)]
    ended = threading.Event()
    cure = suite.cure = (
        "a server calls `prepare` on several threads, also while it calls `reset` and `act` of "
        "other sessions: do not change objects that sessions share, such as a tokenizer's padding; "
        "compute tokens "
        "in `reset`, or hold a lock"
    )

    def prepare(number: int) -> None:
        """Prepare the observations of a session until all rounds have ended."""
        while not ended.is_set():
            i = number % _SESSIONS
            require_same(
                serial[i],
                suite.prepare(i, sessions[i]),
                f"prepare of session {i} on a thread",
                cure,
            )

    with ThreadPoolExecutor(_THREADS) as threads:
        preparing = [threads.submit(prepare, number) for number in range(_THREADS)]
        usual_interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        try:
            begun = time.monotonic()
            for number in range(_ROUNDS):
                if number >= _SESSIONS and time.monotonic() - begun > _LONGEST_S:
                    break
                i = number % _SESSIONS
                *_, session = (suite.begin(i) for _ in range(_RESETS))
                act = suite.act(i, session, prepared=number % 2 == 0)
                require_same(first[i], act, f"act of session {i} while threads prepare", cure)
        finally:
            sys.setswitchinterval(usual_interval)
            ended.set()

    for future in preparing:
        future.result()


@dataclass(slots=True)
class _AgentSuite:
    """Begins sessions, calls their methods, and checks arguments and results."""

    _agent: Agent
    _contract: Contract | None
    _views: list[Obs]  # the observation of each session
    _instructions: list[str]  # the instruction of each session
    _reset_kwargs: dict[str, Any]
    # The cure in messages about errors that the agent raises.
    cure: str = (
        "if the policy parses its instructions or accepts only some observations, pass some that "
        "it accepts: check_agent(…, instructions=[…], obs=[…])"
    )

    def copies(self) -> AgentCopies:
        """Return the copies that a server makes of the initialized agent."""
        return AgentCopies(self._agent)

    def begin(self, i: int) -> Agent:
        """Begin session `i` with a copy of the agent except for its shared objects."""
        shared = {id(value): value for value in self._agent.shared_objects() if value is not None}
        try:
            session = copy.deepcopy(self._agent, dict(shared))
        except (TypeError, AttributeError, NotImplementedError, RuntimeError) as error:
            raise ContractViolation(
                f"the initialized agent cannot be copied for a session: {error}; "
                f"name the attributes that sessions may share in `shared`"
            ) from error

        return self.reset(i, session)

    def reset(self, i: int, session: Agent) -> Agent:
        """Reset a copy of the agent for session `i`, and return it."""
        obs = self._views[i]
        before = copy.deepcopy(obs)
        with self._calling("reset", i):
            info = session.reset(obs, self._instructions[i], seed=i, **self._reset_kwargs)
        require_same(before, obs, "the observation", "reset changed its argument: work on a copy")
        if not isinstance(info, dict):
            raise ContractViolation(f"reset: expected a dict, got {type(info).__name__}")
        require_wireable(info, "reset: info")
        return session

    def play_alone(self, i: int, steps: int) -> list[Act]:
        """Call `act` `steps` times in session `i`, and return copies of the results."""
        session = self.begin(i)
        acts: list[Act] = []
        copies: list[Act] = []
        for _ in range(steps):
            acts.append(self.act(i, session))
            copies.append(copy.deepcopy(acts[-1]))
        require_same(
            copies, acts, "an earlier act", "a later call changed it: return a new array each time"
        )
        return copies

    def act(self, i: int, session: Agent, *, prepared: bool = False) -> Act:
        """Call `act` once in session `i`, with a prepared observation if `prepared`."""
        obs = self._views[i]
        before = copy.deepcopy(obs)
        if prepared:
            obs = replace(obs, prepared=self.prepare(i, session))
        with self._calling("act", i):
            act = session.act(obs)
        require_same(before, obs, "the observation", "act changed its argument: work on a copy")
        return self._checked(act, "act")

    def prepare(self, i: int, session: Agent) -> Any:
        """Return the result of `prepare` in session `i`, for the session's observation."""
        prepares = ability(session, Prepares)
        if prepares is None:
            raise ContractViolation(
                f"prepare: expected the method in the copy of session {i}, as in the agent; define "
                f"it in the class"
            )
        with self._calling("prepare", i):
            return prepares.prepare(self._views[i])

    def act_batch(self, sessions: list[Agent]) -> list[Act]:
        """Call `act_batch` once, with the first `size` sessions."""
        views = self._views[: len(sessions)]
        before = copy.deepcopy(views)
        acts = self._agent.act_batch(views, sessions)
        require_same(
            before, views, "the observations", "act_batch changed its arguments: work on copies"
        )
        if not isinstance(acts, list) or len(acts) != len(sessions):
            result = f"{len(acts)} of them" if isinstance(acts, list) else type(acts).__name__
            raise ContractViolation(
                f"act_batch: expected a list of {len(sessions)} Acts, got {result}"
            )
        return [self._checked(act, "act_batch") for act in acts]

    @contextmanager
    def _calling(self, method: str, i: int) -> Iterator[None]:
        """Convert an error of a method that is called within this context into a
        `ContractViolation`.
        """
        try:
            yield
        except Exception as error:
            event = f"{method}: expected no error, got {error!r} for the instruction "
            event += repr(self._instructions[i])
            if method != "reset":
                event += f" and the observation of session {i}"
            raise ContractViolation(f"{event}; {self.cure}") from error

    def _checked(self, act: object, where: str) -> Act:
        """Return the result of `act`; raise `ContractViolation` if it is no valid `Act`."""
        if isinstance(act, Exception):
            raise ContractViolation(
                f"{where}: failed with {act!r} for an observation that `act` accepts"
            ) from act
        if not isinstance(act, Act):
            raise ContractViolation(f"{where}: expected an Act, got {type(act).__name__}")
        if not isinstance(act.action, np.ndarray) or act.action.dtype != np.float32:
            is_array = isinstance(act.action, np.ndarray)
            kind = act.action.dtype if is_array else type(act.action).__name__
            raise ContractViolation(
                f"{where}: expected the action as a numpy array of float32, got {kind}"
            )

        try:
            check_action(act.action, self._contract)
        except InvalidAction as error:
            raise ContractViolation(f"{where}: {error}") from error

        chunk = self._contract.chunk if self._contract is not None else None
        if chunk not in (None, len(act.rows())):
            raise ContractViolation(
                f"{where}: expected {chunk} rows in the action, as in the contract, got "
                f"{len(act.rows())}"
            )
        if type(act.done) is not bool:
            raise ContractViolation(
                f"{where}: expected done to be a bool, got {type(act.done).__name__}"
            )
        require_wireable(act.info, f"{where}: info")
        return act


def random_observation(
    contract: Contract | None,
    seed: int,
    *,
    image_size: int = _SIDE,
    dims: Mapping[str, int] | None = None,
) -> Obs:
    """Make a random observation that fits a contract; equal seeds give equal observations.

    Args:
        contract: The contract; None for one camera and one state.
        seed: The seed.
        image_size: The height and width, in pixels, of images whose size is not in the contract.
        dims: The sizes of parts of the state whose size is not in the contract.
    """
    rng = np.random.default_rng(seed)
    cameras: Mapping[str, CameraSpec] = {"front": CameraSpec()}
    state: Mapping[str, StateSpec] = {"joints": StateSpec()}
    if contract is not None:
        cameras = cameras if contract.cameras is None else contract.cameras
        state = state if contract.state is None else contract.state

    obs = Obs()
    for name, camera in cameras.items():
        shape = (camera.height or image_size, camera.width or image_size, 3)
        obs.cameras[name] = rng.integers(0, 256, shape, dtype=np.uint8)
    obs.gripper = float(rng.uniform())
    for name, spec in state.items():
        dim = spec.dim or (dims or {}).get(name, _DIM)
        obs.state[name] = rng.uniform(-1, 1, dim).astype(np.float32)
    return obs


def check_env(
    env: EvalEnv,
    *,
    steps: int = 5,
    seeds: tuple[int, int] = (0, 1),
    options: Mapping[str, Any] | None = None,
    same_steps: bool = True,
    step_limit: bool = True,
) -> None:
    """Check that an environment implements the interface of `EvalEnv`; closes the environment.

    The check executes random actions in one episode for each of the two seeds, and then repeats the
    first episode.

    Args:
        env: The environment, not reset yet.
        steps: The number of actions in an episode.
        seeds: The seeds of two different episodes.
        options: The options of each `reset`.
        same_steps: Whether the same actions must also lead to the same observations. Pass False for
            a simulator that is not bit-reproducible; then only the first observation of a seed must
            be the same.
        step_limit: Whether to run one episode until `env.max_steps`; pass False if it takes too
            long.

    Raises:
        ContractViolation: The environment does not implement the interface; the message names the
            method or value.
    """
    if not isinstance(env, EvalEnv):
        raise ContractViolation(
            f"env: expected an EvalEnv, got {env!r}; wrap an environment of Gymnasium with "
            f"make_env('gymnasium/ID')"
        )

    contract = env.contract
    if not isinstance(contract, Contract):
        raise ContractViolation(f"contract: expected a Contract, got {type(contract).__name__}")
    if contract.action.dim is None:
        raise ContractViolation(
            "contract.action.dim: expected the number of components of an action, got None"
        )
    if type(env.max_steps) is not int or env.max_steps < 1:
        raise ContractViolation(f"max_steps: expected an int of at least 1, got {env.max_steps!r}")
    require_wireable(env.describe(), "describe()")
    if not all(isinstance(name, str) for name in env.tasks()):
        raise ContractViolation(f"tasks(): expected a list of names, got {env.tasks()!r}")

    suite = _EnvSuite(env, contract, options)
    actions = suite.random_actions(steps)
    first = suite.play(seeds[0], actions)
    other = suite.play(seeds[1], actions)
    again = suite.play(seeds[0], actions)

    because = "an episode must be a pure function of its seed and options, whatever ran before"
    require_same(first.instruction, again.instruction, "instruction", because)
    require_same(first.copies[0], again.copies[0], "the first observation", because)
    if same_steps:
        for i, (a, b) in enumerate(zip(first.copies, again.copies, strict=False)):
            require_same(a, b, f"the observation after step {i}", because)
        require_same(
            first.outcomes,
            again.outcomes,
            "[reward, terminated, truncated, success] of the steps",
            because,
        )
        suite.check_unseen(seeds[0], actions, first)

    because = "a later step or reset changed it: return new arrays each time"
    for rollout in (first, other, again):
        for i, (obs, obs_copy) in enumerate(zip(rollout.observations, rollout.copies, strict=True)):
            require_same(obs_copy, obs, f"the observation after step {i}", because)

    suite.check_invalid_actions(seeds[0])
    if step_limit:
        suite.check_step_limit(seeds[0])
    check_close(env)


@dataclass(slots=True)
class _Rollout:
    """An episode of random actions."""

    instruction: str
    observations: list[Obs]  # the env's own objects, not copied
    copies: list[Obs]  # copies of these objects, made immediately
    outcomes: list[Any]  # outcomes of each step: reward, terminated, truncated and success


@dataclass(slots=True)
class _EnvSuite:
    """Runs episodes, and checks the results of the environment."""

    _env: EvalEnv
    _contract: Contract
    _options: Mapping[str, Any] | None

    def random_actions(self, count: int) -> list[np.ndarray]:
        """Return random actions within the contract's bounds, (D,) float32 each."""
        spec = self._contract.action
        low = -1.0 if spec.low is None else spec.low
        high = 1.0 if spec.high is None else spec.high
        rows = np.random.default_rng(0).uniform(low, high, (count, spec.dim or 1))
        return list(rows.astype(np.float32))

    def play(self, seed: int, actions: list[np.ndarray]) -> _Rollout:
        """Execute actions in an episode, until it ends."""
        obs = self.reset(seed)
        rollout = _Rollout(self._env.instruction, [obs], [copy.deepcopy(obs)], [])
        for action in actions:
            obs, outcome = self.step(action)
            rollout.observations.append(obs)
            rollout.copies.append(copy.deepcopy(obs))
            rollout.outcomes.append(outcome)
            if outcome[1] or outcome[2]:
                break
        return rollout

    def reset(self, seed: int) -> Obs:
        """Begin an episode, check the results, and return the first observation."""
        result = self._env.reset(seed=seed, options=self._options)
        if not isinstance(result, tuple) or len(result) != 2:
            raise ContractViolation(f"reset: expected (Obs, info), got {kind_of(result)}")
        obs, info = result
        _check_obs(obs, self._contract, "reset")
        if not isinstance(info, dict):
            raise ContractViolation(f"reset: expected the info as a dict, got {kind_of(info)}")
        require_wireable(info, "reset: info")

        instruction = self._env.instruction
        if not isinstance(instruction, str):
            raise ContractViolation(f"instruction: expected a str, got {kind_of(instruction)}")
        if self._contract.instruction and not instruction:
            raise ContractViolation(
                "instruction: expected one, as the contract declares it, got an empty text"
            )
        return obs

    def step(self, action: np.ndarray) -> tuple[Obs, list[Any]]:
        """Execute an action; return the observation, and reward, terminated, truncated and
        success.
        """
        sent = action.copy()
        result = self._env.step(Act(sent))
        require_same(action, sent, "the action", "step must leave the caller's array as it is")
        if not isinstance(result, tuple) or len(result) != 5:
            raise ContractViolation(
                f"step: expected (Obs, reward, terminated, truncated, info), got {kind_of(result)}"
            )

        obs, *outcome, info = result
        _check_obs(obs, self._contract, "step")
        kinds = (("reward", float), ("terminated", bool), ("truncated", bool))
        for (name, kind), value in zip(kinds, outcome, strict=True):
            if type(value) is not kind:
                raise ContractViolation(
                    f"step: expected {name} to be a {kind.__name__}, got {kind_of(value)}"
                )
        if not isinstance(info, dict):
            raise ContractViolation(f"step: expected the info as a dict, got {kind_of(info)}")
        if type(info.get("success")) is not bool:
            raise ContractViolation(
                f"step: expected info['success'] to be a bool, got {kind_of(info.get('success'))}"
            )
        require_wireable(info, "step: info")
        return obs, [*outcome, info["success"]]

    def check_unseen(self, seed: int, actions: list[np.ndarray], rollout: _Rollout) -> None:
        """Repeat an episode, with `looked_at` False until the last step; the only permitted
        difference is that images are absent.
        """
        self.reset(seed)
        last = len(rollout.outcomes) - 1
        because = "`looked_at` may omit images and must change nothing else"
        for i, (action, expected) in enumerate(zip(actions, rollout.copies[1:], strict=False)):
            self._env.looked_at = i == last
            obs, reward, terminated, truncated, info = self._env.step(Act(action.copy()))
            if i != last:
                expected = Obs({}, expected.gripper, expected.state)  # noqa: PLW2901
                obs = Obs({}, obs.gripper, obs.state)
            require_same(expected, obs, f"the observation after step {i}", because)

            outcome = [reward, terminated, truncated, info["success"]]
            require_same(
                rollout.outcomes[i],
                outcome,
                f"[reward, terminated, truncated, success] of step {i}",
                because,
            )

    def check_invalid_actions(self, seed: int) -> None:
        """Check that invalid actions raise `InvalidAction`, and that a valid one then works."""
        self.reset(seed)
        [valid_action] = self.random_actions(1)
        dim = len(valid_action)
        for description, action in (
            (f"of shape ({dim + 1},)", np.append(valid_action, valid_action[0])),
            ("that holds NaN", np.full(dim, np.nan, np.float32)),
        ):
            try:
                self._env.step(Act(action))
            except InvalidAction:
                continue
            except Exception as error:
                raise ContractViolation(
                    f"step: expected InvalidAction for an action {description}, got {error!r}"
                ) from error
            raise ContractViolation(
                f"step: expected InvalidAction for an action {description}, got none: it was "
                "executed"
            )
        self.step(valid_action)

    def check_step_limit(self, seed: int) -> None:
        """Check that an episode is truncated at step `max_steps`, and not before."""
        self.reset(seed)
        [action] = self.random_actions(1)
        limit = self._env.max_steps
        for count in range(1, limit + 1):
            _, (_, terminated, truncated, _) = self.step(action)
            if terminated:
                return
            if truncated != (count == limit):
                state = "is" if truncated else "is not"
                raise ContractViolation(f"step {count} {state} truncated, but max_steps is {limit}")


def _check_obs(obs: object, contract: Contract, where: str) -> None:
    """Raise `ContractViolation` if an observation is invalid or differs from the contract."""
    if not isinstance(obs, Obs):
        raise ContractViolation(f"{where}: expected an Obs as the observation, got {kind_of(obs)}")
    try:
        check_observation(obs, contract)
    except InvalidObservation as error:
        raise ContractViolation(f"{where}: {error}") from error

    for name, values in obs.state.items():
        if values.dtype != np.float32:
            raise ContractViolation(
                f"{where}: state {name!r}: expected float32, got {values.dtype}"
            )
    for kind, names, expected in (
        ("cameras", obs.cameras, contract.cameras),
        ("state", obs.state, contract.state),
    ):
        if expected is not None and set(names) != set(expected):
            raise ContractViolation(
                f"{where}: expected the {kind} of the contract, {sorted(expected)}, got "
                f"{sorted(names)}"
            )
    if contract.gripper is False and obs.gripper is not None:
        raise ContractViolation(
            f"{where}: expected no gripper, as in the contract, got {obs.gripper}"
        )
    require_wireable(obs.info, f"{where}: Obs.info")
