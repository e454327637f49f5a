"""The chunk player: one action a tick out of a policy's chunks, without ever keeping a control loop waiting."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.client.asking import Answer, Asker
from vlagents_ray.client.plan import ENSEMBLE, ENSEMBLE_M, Chunk, Merge, Plan, Step
from vlagents_ray.client.safe import Safe, SafeAction
from vlagents_ray.client.session import copied
from vlagents_ray.contract import ActionSpec, Contract, check_action
from vlagents_ray.errors import ConfigError, InvalidAction, InvalidInput, NotReset, VLAgentsError
from vlagents_ray.interface import AGE, CAPTURED, DEADLINE, DELAY, LEFTOVER, SAFE, SILENT, Act, Agent, Obs

Mode = Literal["open_loop", "ensemble", "async"]
Check = Callable[[np.ndarray, "np.ndarray | None"], np.ndarray]
"""The action and the one before it, (D,) each -> the action to be taken, or `InvalidAction`."""

_WAITING = "waiting for an answer: the last one's rows are executed"
_LATE = "the answer came so late that the ticks of all its rows were over"
_OLD = "the plan is older than max_age_s"
_DELAYS = 10  # requests of which the longest delay is taken


class ChunkPlayer(Agent):
    """An `Agent` around another, local or remote, whose `act` returns single actions, (D,), one a control tick.

    Ticks are counted by the calls of `act`. Row r of a chunk belongs to r ticks after the observation that the
    chunk answers, whenever it comes: rows whose tick is over are dropped. `mode`:

    - "open_loop": execute `execute` rows (default: all), then ask again and wait for the answer;
    - "ensemble": ask at each tick and average what all chunks say of it, with the weights exp(-m * i), oldest
      first (ACT's temporal ensembling; `ensemble_m`);
    - "async": ask in the background while the current chunk is executed, one request at a time, each with the
      newest observation, `execute` ticks apart at the least (default 1). `merge` says what becomes of a tick that
      several chunks have a row for: "newest", "average", "weighted_average", "conservative", "ensemble", or a
      function (see `vlagents_ray.client.plan`). With `real_time_chunking` each request carries what is left of
      the plan and the measured delay (`LEFTOVER`, `DELAY` in `vlagents_ray.interface`) for policies that use them.

    In "async", and in the others with `deadline_s`, `act` returns within `deadline_s` (async: 0 by default): the
    policy's action, or the `safe` one where there is none, with the reason in `act.info["safe"]`. See `SafeAction`
    for what `safe` and `grippers` may be. `info` also tells `age_ticks`, `chunk`, `row`, and `silent_s`, for how
    long an answer has been waited for. Errors that asking again will not cure (`InvalidInput`, and any that is not
    this package's) are raised by the next `act`; the others are the reason of safe actions until the policy answers.
    Without a deadline, errors are raised.

    `reset` may block: it begins the episode and, with a deadline, waits for the first chunk.
    `horizon` is the number of rows of a chunk that may be executed at all; `max_age_s` is how long ago an
    observation may have been handed to `act` for an action made from it to be executed: ticks don't pass while the
    loop itself hangs, time does.
    `timeout_s` gives a request up after that long (default: as the agent does). `check`, such as a
    `vlagents_ray.robot.Guard`, sees every action before it is returned; one that it refuses is replaced.

    An observation without `info["captured_at"]` gets the time at which `act` was called.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        mode: Mode = "open_loop",
        execute: int | None = None,
        merge: str | Merge = "newest",
        ensemble_m: float = ENSEMBLE_M,
        real_time_chunking: bool = False,
        deadline_s: float | None = None,
        timeout_s: float | None = None,
        horizon: int | None = None,
        max_age_s: float | None = None,
        safe: Safe = "auto",
        grippers: Sequence[int] | None = None,
        check: Check | None = None,
    ) -> None:
        if mode not in get_args(Mode):
            raise ConfigError(f"mode: got {mode!r}, want one of {list(get_args(Mode))}")
        for name, value in (("execute", execute), ("horizon", horizon)):
            if value is not None and value < 1:
                raise ConfigError(f"{name}: got {value}, want at least 1, or None")
        if max_age_s is not None and not max_age_s > 0:
            raise ConfigError(f"max_age_s: got {max_age_s}, want above 0, or None")
        if mode != "async" and (merge != "newest" or real_time_chunking):
            raise ConfigError(f"merge and real_time_chunking: got them with mode {mode!r}, want mode='async'")
        self._agent = agent
        self._mode: Mode = mode
        self._execute = execute
        self._deadline_s = 0.0 if deadline_s is None and mode == "async" else deadline_s
        self._timeout_s = timeout_s
        self._horizon = horizon
        self._max_age_s = max_age_s
        self._safe_choice, self._grippers = safe, grippers
        self._check = check
        self._real_time = real_time_chunking
        self._plan = Plan(ENSEMBLE if mode == "ensemble" else merge, ensemble_m)
        self._asker: Asker | None = None
        self._contract: Contract | None = None
        self._begin()

    def _begin(self) -> None:
        self._plan.clear()
        self._tick: int | None = None  # of the next `act`; None outside an episode
        self._chunks = 0
        self._asked, self._asked_at = -1, 0.0  # tick and time (s, of `time.monotonic`) of the last request
        self._waiting_since: float | None = None
        self._trouble = _WAITING
        self._delays: deque[int] = deque(maxlen=_DELAYS)
        self._last: np.ndarray | None = None
        self._safe: SafeAction | None = None

    @property
    def contract(self) -> Contract | None:
        """The policy's, with single actions."""
        if self._tick is None:  # in an episode the policy is busy, and asking a remote one might wait
            self._contract = self._agent.contract
        return None if self._contract is None else replace(self._contract, chunk=1)

    def initialize(self) -> None:
        """Initialize the policy; one that was driven before may still be asked, which is waited for."""
        if self._asker is not None:
            self._asker.settle()
        self._agent.initialize()

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, whatever that takes; what was planned and asked before is forgotten."""
        if self._asker is not None:
            self._asker.settle()
        self._begin()
        obs = _stamped(obs, {})
        info = self._agent.reset(obs, instruction, **kwargs)
        self._contract = self._agent.contract
        if self._deadline_s is not None:
            spec = ActionSpec() if self._contract is None else self._contract.action
            self._safe = SafeAction(self._safe_choice, spec, self._grippers)
            self._note_asked(0)
            self._take(0, self._agent.act(obs), 0)
            if self._asker is None:
                self._asker = Asker(self._agent)
        self._tick = 0
        return info

    def observe(self, obs: Obs) -> None:
        """Show the policy an observation that no action is wanted for."""
        if self._asker is not None:
            self._asker.settle()
        self._agent.observe(obs)

    def act(self, obs: Obs) -> Act:
        """The action of this tick, (D,) float32."""
        tick = self._tick
        if tick is None:
            raise NotReset("act before reset; reset first")
        begun = time.monotonic()
        if self._asker is None or self._deadline_s is None:
            if self._wants(tick):
                self._note_asked(tick)
                self._take(tick, self._agent.act(_stamped(obs, self._extras(tick))), tick)
        else:
            self._ask_in_time(self._asker, obs, tick, begun + self._deadline_s)
        self._tick = tick + 1
        return self._chosen(obs, tick)

    def close(self) -> None:
        """Close the policy, at once or as soon as the request under way is over."""
        if self._asker is not None:
            self._asker.close()
            self._asker = None
        else:
            self._agent.close()
        self._begin()

    def _note_asked(self, tick: int) -> None:
        self._asked, self._asked_at = tick, time.monotonic()

    def _at(self, tick: int) -> Step | None:
        """What is to be done at `tick`, by chunks that are young enough."""
        return self._plan.at(tick, -math.inf if self._max_age_s is None else time.monotonic() - self._max_age_s)

    def _wants(self, tick: int) -> bool:
        """Is an answer to this tick's observation wanted?"""
        step = self._at(tick)
        if step is None:
            return True
        if step.chunk.done:
            return False
        if self._mode == "open_loop":
            return self._execute is not None and tick - step.chunk.tick >= self._execute
        return tick - self._asked >= (self._execute or 1)

    def _ask_in_time(self, asker: Asker, obs: Obs, tick: int, deadline: float) -> None:
        """Take what has come, ask if it is time to, and wait for the answer as long as is allowed and needed."""
        self._receive(asker.take(), tick)
        if asker.idle and self._wants(tick):
            self._note_asked(tick)
            if self._waiting_since is None:
                self._waiting_since = time.monotonic()
            asker.ask(tick, _stamped(copied(obs), self._extras(tick)))
        while not asker.idle and (left_s := deadline - time.monotonic()) > 0:
            fresh = self._mode != "async" and self._asked == tick
            if not fresh and self._at(tick) is not None:
                break
            self._receive(asker.take(left_s), tick)

    def _receive(self, answer: Answer | None, tick: int) -> None:
        if answer is None:
            return
        if isinstance(answer.result, Act):
            try:
                self._take(answer.tick, answer.result, tick)
                self._waiting_since = None
            except InvalidAction as error:
                self._trouble = str(error)
            return
        if isinstance(answer.result, InvalidInput) or not isinstance(answer.result, VLAgentsError):
            raise answer.result
        self._trouble = f"{answer.result.code}: {answer.result}"

    def _take(self, asked: int, act: Act, now: int) -> None:
        rows = Act(check_action(act.action, self._contract)).rows()[: self._horizon]
        if self._mode == "open_loop" and act.done and self._execute is not None:
            rows = rows[: self._execute]
        late = self._plan.add(Chunk(self._chunks, asked, rows, act.done, act.info, self._asked_at), now)
        self._trouble = _LATE if late == len(rows) else _WAITING
        self._chunks += 1
        self._delays.append(now - asked)

    def _extras(self, tick: int) -> dict[str, Any]:
        extras: dict[str, Any] = {}
        if self._timeout_s is not None:
            extras[DEADLINE] = self._timeout_s * 1e3
        if self._real_time and (leftover := self._plan.leftover(tick)) is not None:
            extras |= {LEFTOVER: leftover, DELAY: max(self._delays, default=0)}
        return extras

    def _chosen(self, obs: Obs, tick: int) -> Act:
        step = self._at(tick)
        silent_s = 0.0 if self._waiting_since is None else time.monotonic() - self._waiting_since
        reason = _OLD if step is None and self._plan.at(tick) is not None else self._trouble
        if step is not None:
            try:
                action = step.action if self._check is None else self._check(step.action, self._last)
                self._last = action
                return _played(action, step, tick, silent_s)
            except InvalidAction as error:
                reason = str(error)
                if self._safe is None:
                    raise
        if self._safe is None or self._last is None:
            raise InvalidAction(f"no action for this tick, nor a safe one to begin with: {reason}")
        self._last = self._safe(obs, self._last)
        return Act(self._last.copy(), info={SAFE: reason, SILENT: silent_s})


def _played(action: np.ndarray, step: Step, tick: int, silent_s: float) -> Act:
    chunk = step.chunk
    about = {AGE: tick - chunk.tick, "chunk": chunk.number, "row": step.row, SILENT: silent_s}
    return Act(action.copy(), chunk.done and tick == chunk.end - 1, {**chunk.info, **about})


def _stamped(obs: Obs, extras: dict[str, Any]) -> Obs:
    """With the time of capture, and what else travels with the request; the caller's stays as it is."""
    return replace(obs, info={CAPTURED: time.time(), **obs.info, **extras})
