"""`check_agent`: a test suite for the interface of `Agent`."""

from __future__ import annotations

import copy
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.testing.comparing import ContractViolation, check_close, require_same, require_wireable
from vlagents_ray.validation import check_action

_SIDE = 64  # px, of a random image whose size the contract does not state
_DIM = 7  # length of a part of the state whose size the contract does not state
_SESSIONS = 3
_THREADS = 4  # number of threads that prepare observations in a server
_ROUNDS = 20  # acts concurrent with those threads, each after `_RESETS` resets
_RESETS = 15  # since a reset is short, few of them coincide with a preparation
_LONGEST_S = 5.0  # time after which no further act begins, since other threads slow down the agent
_SWITCH_S = 1e-5  # Python's switch interval, short so that threads interleave more often


def check_agent(
    agent: Agent,
    *,
    obs: Obs | Sequence[Obs] | None = None,
    instructions: Sequence[str] = ("pick up the cube", "push the cube", "open the drawer"),
    reset_kwargs: Mapping[str, Any] | None = None,
    steps: int = 3,
    atol: float = 1e-5,
) -> None:
    """Check that an agent implements the interface of `Agent`; initializes and closes it.

    Three sessions, copies of the initialized agent, run with an observation, an instruction and a seed each: first in
    sequence, then interleaved, with prepared observations, then in batches of 1, 2 and 3. Their actions must not depend
    on the other sessions, nor on whether `prepare` was called. If the agent defines `prepare`, several threads call it
    while sessions are reset and acted on, as in a server, and every result must equal that of a single thread.

    Args:
        agent: The agent, not initialized yet.
        obs: The observations of the sessions, in turn; by default random values that fit the contract.
        instructions: The instructions of the sessions, in turn; pass valid ones if the policy parses them.
        reset_kwargs: Further arguments of each `reset`, beside `seed`.
        steps: The number of calls of `act` in a session.
        atol: The largest difference between an action in a batch and the same action of a single session.

    Raises:
        ContractViolation: The agent does not implement the interface; the message names the place.
    """
    agent.initialize()
    contract = agent.contract
    if contract is not None and not isinstance(contract, Contract):
        raise ContractViolation(f"contract: got {type(contract).__name__}, want a Contract or None")
    views = (
        [obs]
        if isinstance(obs, Obs)
        else list(obs or [random_observation(contract, seed) for seed in range(_SESSIONS)])
    )
    suite = _Suite(agent, contract, views, instructions, dict(reset_kwargs or {}))

    alone = [suite.play_alone(i, steps) for i in range(_SESSIONS)]
    because = "the same observations, instruction and seed must give the same actions"
    for i, again in enumerate([suite.play_alone(i, steps) for i in range(_SESSIONS)]):
        require_same(alone[i], again, f"act of session {i}", because)
    because = "it depends on other sessions: keep what belongs to an episode in self, and out of `shared`"
    sessions = [suite.begin(i) for i in range(_SESSIONS)]
    for step in range(steps):
        for i, session in enumerate(sessions):
            require_same(alone[i][step], suite.act(i, session), f"act {step} of session {i}", because)
    if type(agent).prepare is not Agent.prepare:
        because = "`prepare` must compute what `act` computes without it"
        for i, session in enumerate([suite.begin(i) for i in range(_SESSIONS)]):
            for step in range(steps):
                where = f"act {step} of session {i} on a prepared observation"
                require_same(alone[i][step], suite.act(i, session, prepared=True), where, because)
        _check_threads(suite, [acts[0] for acts in alone])
    because = "act_batch must give each session what act gives it alone"
    for size in range(1, _SESSIONS + 1):
        batch = [suite.begin(i) for i in range(size)]
        for step in range(steps):
            for i, act in enumerate(suite.act_batch(batch)):
                where = f"act {step} of session {i} in a batch of {size}"
                require_same(alone[i][step], act, where, because, atol)
    check_close(agent)


def _check_threads(suite: _Suite, first: list[Act]) -> None:
    """Check that threads can prepare observations while sessions, with the acts `first`, are reset and acted on."""
    sessions = [suite.begin(i) for i in range(_SESSIONS)]
    serial = [suite.prepare(i, session) for i, session in enumerate(sessions)]
    ended = threading.Event()
    cure = suite.cure = (
        "a server calls `prepare` on several threads, also while others are reset and acted on: change nothing in it "
        "that sessions share, such as a tokenizer's padding; compute tokens in `reset`, or hold a lock"
    )

    def prepare(number: int) -> None:
        while not ended.is_set():
            i = number % _SESSIONS
            require_same(serial[i], suite.prepare(i, sessions[i]), f"prepare of session {i} on a thread", cure)

    with ThreadPoolExecutor(_THREADS) as threads:
        running = [threads.submit(prepare, number) for number in range(_THREADS)]
        usual = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        try:
            begun = time.monotonic()
            for number in range(_ROUNDS):
                if number >= _SESSIONS and time.monotonic() - begun > _LONGEST_S:
                    break
                i = number % _SESSIONS
                *_, session = (suite.begin(i) for _ in range(_RESETS))
                found = suite.act(i, session, prepared=number % 2 == 0)
                require_same(first[i], found, f"act of session {i} while threads prepare", cure)
        finally:
            sys.setswitchinterval(usual)
            ended.set()
    for one in running:
        one.result()


@dataclass(slots=True)
class _Suite:
    """Begins sessions and calls them, and checks their arguments and results."""

    _agent: Agent
    _contract: Contract | None
    _views: list[Obs]
    _instructions: Sequence[str]
    _reset_kwargs: dict[str, Any]
    cure: str = (  # of errors that the agent raises
        "if the policy parses its instructions or takes only some observations, give "
        "check_agent(…, instructions=[…], obs=[…]) those that it knows"
    )

    def begin(self, i: int) -> Agent:
        """Begin session `i`: copy the agent except for its shared objects, and reset the copy."""
        shared = {id(value): value for value in self._agent.shared_objects() if value is not None}
        try:
            session = copy.deepcopy(self._agent, dict(shared))
        except (TypeError, AttributeError, NotImplementedError, RuntimeError) as error:
            raise ContractViolation(
                f"the initialized agent cannot be copied for a session: {error}; "
                f"name the attributes that sessions may share in `shared`"
            ) from error
        obs = self._view(i)
        before = copy.deepcopy(obs)
        with self._calling("reset", i):
            info = session.reset(obs, self._instruction(i), seed=i, **self._reset_kwargs)
        require_same(before, obs, "the observation", "reset changed the caller's: work on a copy")
        if not isinstance(info, dict):
            raise ContractViolation(f"reset: got {type(info).__name__}, want a dict")
        require_wireable(info, "reset: info")
        return session

    def play_alone(self, i: int, steps: int) -> list[Act]:
        session = self.begin(i)
        given = [self.act(i, session)]
        kept = [copy.deepcopy(given[0])]
        for _ in range(steps - 1):
            given.append(self.act(i, session))
            kept.append(copy.deepcopy(given[-1]))
        require_same(kept, given, "an earlier act", "a later one changed it: give a new array each time")
        return kept

    def act(self, i: int, session: Agent, *, prepared: bool = False) -> Act:
        obs = self._view(i)
        before = copy.deepcopy(obs)
        if prepared:
            obs = replace(obs, prepared=self.prepare(i, session))
        with self._calling("act", i):
            act = session.act(obs)
        require_same(before, obs, "the observation", "act changed the caller's: work on a copy")
        return self._checked(act, "act")

    def prepare(self, i: int, session: Agent) -> Any:
        with self._calling("prepare", i):
            return session.prepare(self._view(i))

    def act_batch(self, sessions: list[Agent]) -> list[Act]:
        views = [self._view(i) for i in range(len(sessions))]
        before = copy.deepcopy(views)
        acts = self._agent.act_batch(views, sessions)
        require_same(before, views, "the observations", "act_batch changed the caller's: work on copies")
        if not isinstance(acts, list) or len(acts) != len(sessions):
            got = f"{len(acts)} of them" if isinstance(acts, list) else type(acts).__name__
            raise ContractViolation(f"act_batch: got {got}, want a list of {len(sessions)} acts")
        return [self._checked(act, "act_batch") for act in acts]

    @contextmanager
    def _calling(self, method: str, i: int) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            got = f"{method}: raised {error!r} for the instruction {self._instruction(i)!r}"
            if method != "reset":
                got += f" and the observation of session {i}"
            raise ContractViolation(f"{got}, want no error; {self.cure}") from error

    def _instruction(self, i: int) -> str:
        return self._instructions[i % len(self._instructions)]

    def _view(self, i: int) -> Obs:
        return self._views[i % len(self._views)]

    def _checked(self, act: object, where: str) -> Act:
        if isinstance(act, Exception):
            raise ContractViolation(f"{where}: failed with {act!r} for an observation that `act` takes") from act
        if not isinstance(act, Act):
            raise ContractViolation(f"{where}: got {type(act).__name__}, want an Act")
        if not isinstance(act.action, np.ndarray) or act.action.dtype != np.float32:
            got = act.action.dtype if isinstance(act.action, np.ndarray) else type(act.action).__name__
            raise ContractViolation(f"{where}: the action is {got}, want a numpy array of float32")
        try:
            check_action(act.action, self._contract)
        except InvalidAction as error:
            raise ContractViolation(f"{where}: {error}") from error
        chunk = self._contract.chunk if self._contract is not None else None
        if chunk not in (None, len(act.rows())):
            raise ContractViolation(f"{where}: the action has {len(act.rows())} rows, the contract states {chunk}")
        if type(act.done) is not bool:
            raise ContractViolation(f"{where}: done is {type(act.done).__name__}, want a bool")
        require_wireable(act.info, f"{where}: info")
        return act


def random_observation(
    contract: Contract | None, seed: int, *, side: int = _SIDE, dims: Mapping[str, int] | None = None
) -> Obs:
    """Make a random observation that fits a contract; equal seeds give equal observations.

    Args:
        contract: The contract; None for one camera and one state.
        seed: The seed.
        side: Height and width of images whose size the contract does not state, pixels.
        dims: Sizes of parts of the state that the contract does not state.
    """
    rng = np.random.default_rng(seed)
    cameras: Mapping[str, CameraSpec] = {"front": CameraSpec()}
    state: Mapping[str, StateSpec] = {"joints": StateSpec()}
    if contract is not None:
        cameras = cameras if contract.cameras is None else contract.cameras
        state = state if contract.state is None else contract.state
    sizes = {name: part.dim or (dims or {}).get(name, _DIM) for name, part in state.items()}
    return Obs(
        cameras={
            name: rng.integers(0, 256, (camera.height or side, camera.width or side, 3), dtype=np.uint8)
            for name, camera in cameras.items()
        },
        gripper=float(rng.uniform()),
        state={name: rng.uniform(-1, 1, size).astype(np.float32) for name, size in sizes.items()},
    )
