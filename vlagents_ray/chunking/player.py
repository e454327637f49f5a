"""The chunk player: one action per tick from a policy's chunks, without blocking a control loop."""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np

from vlagents_ray.abilities import HasStatistics, Observes, ReadsSlo, ability
from vlagents_ray.chunking.buffer import (
    ENSEMBLE,
    ENSEMBLE_M,
    CaptureClock,
    Chunk,
    ChunkBuffer,
    DelayEstimate,
    Merge,
    Mode,
    Step,
    stamped,
)
from vlagents_ray.chunking.control import Leader, RobotControl
from vlagents_ray.chunking.fallback import (
    LATE,
    OLD,
    RELEASED,
    STALE,
    STOPPED,
    WAITING,
    Check,
    Held,
    Motion,
    Safe,
    SafeAction,
    refused,
    unanswered,
)
from vlagents_ray.chunking.timeliness import Timeliness
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction, InvalidInput, NotReset, VLAgentsError
from vlagents_ray.interface import (
    AGE_MS,
    CAUSE,
    DEADLINE,
    EXECUTED,
    EXECUTED_AGE,
    IN_TIME,
    INTERVENTION,
    OF_THE_LOOP,
    REPLAN,
    SAFE,
    SILENT,
    SLACK,
    SLO,
    TICKS,
    WANTED,
    Act,
    Agent,
    Obs,
    copied,
)
from vlagents_ray.validation import check_action

_CLOSE_S = 2.0
# The largest number of actions between two requests that are recorded as executed in place of the
# policy's.
_MAX_REPLACEMENTS = 256
_TIMED_TICKS = 10  # the number of ticks from whose intervals the rate of the loop is measured
_KEPT_WIRE = 0.9  # the part of the longest time on the way that is left after another answer
_LONGEST_REPLAN_MS = 1e9  # the longest delay of a request that a server may ask for


class AsyncCaller:
    """A thread that calls `agent.act`, so that the caller's own thread never waits for it.

    Only one thread may use it, and nothing else may use the agent during a request; `settle` waits
    for its end.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._jobs: queue.SimpleQueue[Obs | None] = queue.SimpleQueue()  # None ends the thread
        self._answers: queue.SimpleQueue[Act | Exception] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-caller", daemon=True)
        self._thread.start()
        self.idle = True
        """Whether there is no request in progress and no answer to take."""

    @property
    def busy(self) -> bool:
        """Whether a request is in progress."""
        return not self.idle and self._answers.empty()

    def ask(self, obs: Obs) -> None:
        """Begin a request, only while `idle`. The caller must not change `obs` afterwards."""
        self.idle = False
        self._jobs.put(obs)

    def take(self, wait_s: float = 0.0) -> Act | Exception | None:
        """Return the policy's answer or its error within `wait_s` seconds, or None."""
        try:
            answer = self._answers.get(timeout=wait_s) if wait_s else self._answers.get_nowait()
        except queue.Empty:
            return None
        self.idle = True
        return answer

    def settle(self) -> None:
        """Wait for the end of the request in progress, without a time limit, and drop its
        answer.
        """
        if not self.idle:
            self._answers.get()
            self.idle = True

    def close(self) -> None:
        """Close the agent as soon as its request is over; wait at most two seconds for that."""
        self._jobs.put(None)
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        while (obs := self._jobs.get()) is not None:
            try:
                self._answers.put(self._agent.act(obs))
            except Exception as error:  # noqa: BLE001 - raised or reported where the answer is taken
                self._answers.put(error)
        self._agent.close()


class _Request(NamedTuple):
    """The last request to the policy."""

    tick: int = -1  # the tick of its observation
    # `ChunkBuffer.executed` at its observation: the position of the answer's first row.
    step: int = 0
    seen_at: float = 0.0  # s, of `time.monotonic`: the capture time of the observation


@dataclass(frozen=True)
class PlayerSettings:
    """The settings of a `ChunkPlayer`: its requests to the policy, and its use of the answers.

    Raises:
        ConfigError: A setting is out of range, or settings contradict each other.
    """

    mode: Mode = "open_loop"
    """With "open_loop", execute `execute` rows, then send a request and wait for the answer. With
    "ensemble", send one at each tick, and average the actions of all chunks with the weights exp(-m
    * i), oldest first (ACT's temporal ensembling). With "async", send requests in the background,
    one at a time, with the newest observation.
    """
    # The number of rows of a chunk between two requests (default: all), or in "async" the number of
    # ticks (default: 1).
    execute: int | None = None
    merge: str | Merge = "newest"
    """The combination of several chunks' rows for one tick, in "async": "newest", "average",
    "weighted_average", "conservative", "ensemble", or a function (see
    `vlagents_ray.chunking.buffer`).
    """
    ensemble_m: float = ENSEMBLE_M  # the m of the weights
    real_time_chunking: bool = False
    """Whether each request contains the rest of the plan and the measured delay (`LEFTOVER`,
    `DELAY` in `vlagents_ray.interface`), for policies that use them; in "async" only.
    """
    deadline_s: float | None = None  # time limit of `act`; 0 by default in "async", else none
    timeout_s: float | None = None  # time limit of a request; by default the agent's
    # The largest number of rows of a chunk to execute; a chunk with `done` is executed whole.
    horizon: int | None = None
    max_age_s: float | None = None
    """The largest age of the observation of an executed action. The age counts from
    `info["captured_at"]`, that of the sensor read first, or from the call of `act` (see
    `CaptureClock`).
    """
    safe: Safe = "auto"  # the action in place of a missing one (see `SafeAction`)
    # The columns of the action that are grippers (see `SafeAction`).
    grippers: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ConfigError(f"mode: expected one of {list(get_args(Mode))}, got {self.mode!r}")
        for name, value in (("execute", self.execute), ("horizon", self.horizon)):
            if value is not None and value < 1:
                raise ConfigError(f"{name}: expected a number of at least 1, or None, got {value}")
        if self.max_age_s is not None and not self.max_age_s > 0:
            raise ConfigError(
                f"max_age_s: expected a number above 0, or None, got {self.max_age_s}"
            )
        if self.mode != "async" and (self.merge != "newest" or self.real_time_chunking):
            raise ConfigError(
                "merge and real_time_chunking: expected mode='async' with them, got "
                f"mode={self.mode!r}"
            )
        if self.mode == "async" and self.deadline_s is None:
            object.__setattr__(self, "deadline_s", 0.0)


class ChunkPlayer(Agent):
    """An `Agent` around another, local or remote, whose `act` returns single actions, (D,), one per
    control tick.

    Ticks are counted by the calls of `act`. Row r of a chunk is for r executed actions after the
    chunk's observation, whenever the chunk arrives: rows for ticks at which others were executed
    are skipped, except while the robot holds still (see
    `vlagents_ray.chunking.buffer.ChunkBuffer`). `reset` may block: it begins the episode and, with
    a deadline, waits for the first chunk.

    In mode "async", and in the others with `deadline_s`, `act` returns within `deadline_s`: the
    policy's action, or the `safe` one if that is missing, with the reason in `act.info["safe"]` and
    its kind in `act.info["safe_cause"]`. `info` also has `age_ticks`, `chunk`, `row`, and
    `silent_s`, the time since the oldest unanswered request. Errors that another request cannot
    cure (`InvalidInput`, and any that is not this package's) are raised by the next `act`; the
    others are the reason of safe actions until the policy answers. Without a deadline, errors are
    raised.
    """

    statistics: dict[str, Any] | None = None
    """The ranges of the policy's training, once it is initialized; see `HasStatistics`."""

    control: RobotControl
    """The state of the robot, which selects the source of motion at each `act`."""

    timeliness: Timeliness
    """The share of the episode's ticks that had an action of the policy in time."""

    def __init__(
        self,
        agent: Agent,
        settings: PlayerSettings | None = None,
        *,
        check: Check | None = None,
        override: Leader | None = None,
    ) -> None:
        """Play the chunks of a policy.

        Args:
            agent: The policy, in this process or a `RemoteAgent`.
            settings: The requests to the policy, and the use of its answers; default:
                `PlayerSettings()`.
            check: Checks every action before it is returned, such as a `vlagents_ray.robot.Guard`.
                If it rejects an action of the policy, the safe one replaces it, and the plan is
                dropped. If it rejects a safe action, the last action replaces it if that holds the
                robot still; otherwise `act` raises `InvalidAction`. The check also receives the
                last action. A `Guard` with `measure` uses the measured pose if there is none, and
                after safe actions.
            override: The operator's device. While it is engaged, `act` returns its actions with
                `info["intervention"]` and, if known, `info["policy_action"]`. `check` also applies
                to them.
        """
        self.settings = settings = settings or PlayerSettings()
        self.check = check
        self.control = RobotControl(override)
        self._agent = agent
        merge = ENSEMBLE if settings.mode == "ensemble" else settings.merge
        self._plan = ChunkBuffer(merge, settings.ensemble_m)
        self._caller: AsyncCaller | None = None
        self._contract: Contract | None = None
        self._delay = DelayEstimate()
        self._begin()

    def _begin(self) -> None:
        self._plan.drop()
        self._tick: int | None = None  # the tick of the next `act`; None outside an episode
        self._request = _Request()  # the last request
        self._drops_answer = False  # whether the answer to it must not be executed
        # The actions, (D,), that were executed in place of the policy's since the last request.
        self._replacements = deque[np.ndarray](maxlen=_MAX_REPLACEMENTS)
        self._is_replaced = False  # whether this tick has such an action
        self._chunks = 0  # the number of answers
        # When the oldest unanswered request was sent, s of `time.monotonic`; None if there is none.
        self._waiting_since: float | None = None
        self._reason = WAITING  # why the plan has no row, if it has none
        # Whether the policy has yet to answer after the plan was dropped, as the robot was stopped
        # or moved, or the guard rejected a row.
        self._begins_again = False
        self.timeliness = Timeliness()
        self._executed_age_ms: float | None = None  # of the last row since the last request
        # When the last ticks began, s of `time.monotonic`.
        self._tick_begins: deque[float] = deque(maxlen=_TIMED_TICKS)
        self._wire_ms = 0.0  # the longest time that a request and its answer were on the way, ms
        self._inference_ms = 0.0  # the time of the last batch, ms
        # Time before which the server needs no further request, s of `time.monotonic`.
        self._replan_at = 0.0
        self._captured = CaptureClock()
        self._motion = Motion(self.check)

    @property
    def contract(self) -> Contract | None:
        """The policy's contract, with single actions."""
        # During an episode the policy is busy, and a call to a remote one might block.
        if self._tick is None:
            self._contract = self._agent.contract
        return None if self._contract is None else replace(self._contract, chunk=1)

    def initialize(self) -> None:
        """Initialize the policy; wait for a request in progress, if the policy was used before."""
        if self._caller is not None:
            self._caller.settle()
        self._agent.initialize()
        trained_on = ability(self._agent, HasStatistics)
        self.statistics = None if trained_on is None else trained_on.statistics
        self._choose_safe()

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, without a time limit; the plan and pending requests are dropped."""
        if self._caller is not None:
            self._caller.settle()
        self._begin()
        obs = stamped(obs, {})
        self._captured(obs)  # before the reset of the policy, which may take long
        slo = kwargs.get(SLO)
        if slo is not None and self.settings.horizon is not None:
            kwargs[SLO] = {"rows": self.settings.horizon, **slo}
        info = self._agent.reset(obs, instruction, **kwargs)
        self._choose_safe()

        if self.settings.deadline_s is not None:
            if self._caller is None:
                self._caller = AsyncCaller(self._agent)
            self._record_request(0, obs)
            answer = self._agent.act(stamped(obs, self._request_info()))
            self._take(answer)
            self._record_timing(answer)
        self._tick = 0
        return info

    @property
    def reads_slo(self) -> bool:
        """Whether the policy's server reads an SLO at a reset."""
        reads = ability(self._agent, ReadsSlo)
        return reads is not None and reads.reads_slo

    def interrupt(self) -> None:
        """Drop the plan: the robot was stopped or moved, and did not execute the last action of
        `act`.

        Answers to earlier observations are discarded, and the policy is queried again. `run_loop`
        calls this at each tick at which it holds the robot; call it in your own loop when you stop
        or take over the robot.
        """
        self._begin_again(STOPPED)
        if self._is_replaced:  # its action was not executed
            self._replacements.pop()
            self._is_replaced = False
        self._motion.stop()
        self._rebase_leader(None)

    def observe(self, obs: Obs, action: np.ndarray | None = None) -> None:
        """Pass an observation to the policy without requesting an action.

        Args:
            obs: The observation.
            action: The action that the robot executed in place of the policy's, (D,), if your own
                loop chose it. It counts as a tick, and the next request contains it (`EXECUTED` in
                `vlagents_ray.interface`).

        Raises:
            InvalidAction: The check rejects the action.
        """
        if self._caller is not None:
            self._caller.settle()
        observes = ability(self._agent, Observes)
        if observes is not None:
            observes.observe(obs)
        if action is not None and self._tick is not None:
            self._record_replacement(self._motion.move(action, obs))
            self._plan.advance()
            self._tick += 1

    def act(self, obs: Obs) -> Act:
        """Return the action of this tick, (D,) float32."""
        tick = self._tick
        if tick is None:
            raise NotReset("act was called before reset; reset first")
        begun = time.monotonic()
        self._tick_begins.append(begun)
        self._motion.tick()
        self._is_replaced = False
        if self.control.update():
            self._begin_again(RELEASED)
        is_operated = self.control.state == "human"

        try:
            self._update_plan(obs, tick, begun)
        except Exception as error:
            if not is_operated:
                raise
            # The operator continues, without a known action of the policy.
            self._reason = Held("failed", str(error))
        self._tick = tick + 1

        if not is_operated:
            act = self._policy_act(obs, tick)
            self.timeliness.count(act.info)
            self._executed_age_ms = act.info.get(AGE_MS, self._executed_age_ms)
            return act
        act = self._operator_act(obs)
        if SAFE not in act.info:  # the operator's action is executed in place of a row
            self._record_replacement(act.action)
            self._plan.advance()
        return act

    def close(self) -> None:
        """Close the policy, at once or as soon as the request in progress is over."""
        if self._caller is not None:
            self._caller.close()
            self._caller = None
        else:
            self._agent.close()
        self._begin()

    def _update_plan(self, obs: Obs, tick: int, begun: float) -> None:
        """Take the policy's answer, send the next request if it is due, and wait as long as
        allowed and needed.
        """
        caller = self._caller
        if caller is None or self.settings.deadline_s is None:
            if self._is_request_due(tick, obs):
                self._record_request(tick, obs)
                self._take(self._agent.act(stamped(obs, self._request_info())))
            return

        self._receive(caller.take(), tick)
        if caller.idle and self._is_request_due(tick, obs):
            self._record_request(tick, obs)
            if self._waiting_since is None:
                self._waiting_since = time.monotonic()
            caller.ask(stamped(copied(obs), self._request_info()))

        # Wait only for an action that will be executed.
        wait_s = self.settings.deadline_s if self.control.state == "autonomous" else 0.0
        deadline = begun + wait_s
        while not caller.idle:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                break
            is_of_this_tick = self.settings.mode != "async" and self._request.tick == tick
            if not is_of_this_tick and self._next() is not None:
                break
            self._receive(caller.take(left_s), tick)

    def _choose_safe(self) -> None:
        """Choose the safe action; raises `ConfigError` if it does not fit the policy's actions."""
        self._contract = self._agent.contract
        spec = ActionSpec() if self._contract is None else self._contract.action
        safe: SafeAction | None = None
        if self.settings.deadline_s is not None or self.control.leader is not None:
            safe = SafeAction(self.settings.safe, spec, self.settings.grippers)
        self._motion = Motion(self.check, self._contract, safe)

    def _record_replacement(self, action: np.ndarray) -> None:
        """Record an action that is executed in place of the policy's."""
        self._replacements.append(action)
        self._is_replaced = True

    def _record_request(self, tick: int, obs: Obs) -> None:
        """Record that a request with this tick's observation is being sent."""
        self._request = _Request(tick, self._plan.executed, self._captured(obs))
        self._drops_answer = self._motion.keeps(self._plan)

    def _is_old(self, seen_at: float) -> bool:
        max_age_s = self.settings.max_age_s
        return max_age_s is not None and seen_at < time.monotonic() - max_age_s

    def _next(self) -> Step | None:
        """Return the current action from chunks whose observations are recent enough."""
        max_age_s = self.settings.max_age_s
        if max_age_s is not None and self._plan.drop(time.monotonic() - max_age_s):
            self._reason = OLD
        return self._plan.next

    def _is_request_due(self, tick: int, obs: Obs) -> bool:
        """Return whether a request with this tick's observation is due."""
        if self._is_old(self._captured(obs)):
            return False
        step = self._next()
        if step is None or step.chunk.done:
            return step is None
        if self.settings.mode == "open_loop":
            return self.settings.execute is not None and step.row >= self.settings.execute

        # This also holds for every answer with a single action.
        is_last_row = step.chunk.end == self._plan.executed + 1
        if is_last_row:
            return True
        if tick - self._request.tick < (self.settings.execute or 1):
            return False
        if time.monotonic() >= self._replan_at:
            return True
        # It waits no longer than an urgent request can be answered in time. The wait in the queue
        # does not count: otherwise robots would ask the more often the longer the queue is.
        return self._slack_ms() <= self._inference_ms + 2 * self._period_ms()

    def _receive(self, answer: Act | Exception | None, tick: int) -> None:
        """Add the answer of the policy to the plan, if there is one; raise an error that another
        request cannot cure.
        """
        if answer is None:
            return
        if isinstance(answer, Act):
            try:
                if not (self._drops_answer or self._motion.keeps(self._plan)):
                    self._delay.add(tick - self._request.tick)
                    self._take(answer)
                self._waiting_since = None
                self._record_timing(answer)
            except InvalidAction as error:
                self._reason = refused(error)
            return
        if isinstance(answer, InvalidInput) or not isinstance(answer, VLAgentsError):
            raise answer
        self.timeliness.failed(answer)
        self._reason = unanswered(answer)
        self._begins_again = False

    def _record_timing(self, answer: Act) -> None:
        """Record how long an answer was on the way, and when the server needs the next request."""
        timing = answer.info.get("timing")
        if isinstance(timing, Mapping):  # else it is not that of a `RemoteAgent`
            self._wire_ms = max(timing.get("wire_ms", 0.0), _KEPT_WIRE * self._wire_ms)
            self._inference_ms = timing.get("inference_ms", 0.0)
        replan_ms = answer.info.get(REPLAN)
        self._replan_at = 0.0
        if isinstance(replan_ms, (int, float)) and 0 < replan_ms <= _LONGEST_REPLAN_MS:
            self._replan_at = time.monotonic() + replan_ms / 1e3

    def _slack_ms(self) -> float:
        """Return the time, ms, that the server has for the answer to a request of this tick: until
        the tick after the last row that is left, without the time on the way.
        """
        return max(0.0, self._plan.known * self._period_ms() - self._wire_ms)

    def _period_ms(self) -> float:
        """Return the period of the loop, ms, from its last ticks; 0 before the second one."""
        intervals_s = sorted(end - begin for begin, end in itertools.pairwise(self._tick_begins))
        return 1e3 * intervals_s[len(intervals_s) // 2] if intervals_s else 0.0

    def _take(self, act: Act) -> None:
        """Add the chunk of an answer to the plan."""
        info = {key: value for key, value in act.info.items() if key not in OF_THE_LOOP}
        rows = Act(check_action(act.action, self._contract)).rows()
        if not act.done:  # the task is done with the last row of this chunk, not before
            rows = rows[: self.settings.horizon]

        tick, step, seen_at = self._request
        added = self._plan.add(Chunk(self._chunks, step, rows, act.done, info, tick, seen_at))
        self._chunks += 1
        self._reason = WAITING if added else LATE
        self._begins_again = False

    def _request_info(self) -> dict[str, Any]:
        """Return the entries that the next request adds to the info of its observation."""
        info: dict[str, Any] = {}
        if self._replacements:
            info[EXECUTED] = np.stack(self._replacements)
            self._replacements.clear()
        if self.settings.timeout_s is not None:
            info[DEADLINE] = self.settings.timeout_s * 1e3

        if self._caller is not None:  # otherwise the robot waits for each answer
            info[SLACK] = self._slack_ms()
            info[TICKS] = self.timeliness.report()
            if self._executed_age_ms is not None:
                info[EXECUTED_AGE] = self._executed_age_ms
                self._executed_age_ms = None

        # While an operator acts, their actions replace those of the plan.
        if self.settings.real_time_chunking and self.control.state != "human":
            info |= self._plan.continuation(self._delay.ticks)
        return info

    def _operator_act(self, obs: Obs) -> Act:
        """Return the operator's action, or the safe one if the guard rejects it."""
        # A silent policy does not stop an operator.
        info: dict[str, Any] = {INTERVENTION: True, SILENT: 0.0}
        planned = self._next()
        if planned is not None:
            info[WANTED] = planned.action.copy()

        try:
            try:
                action = np.array(self.control.leader.action(obs), np.float32)  # type: ignore[union-attr]
            except Exception as error:
                raise InvalidAction(f"leader: {error}", cause="leader") from error
            action = self._motion.move(action, obs)
        except InvalidAction as error:
            action, why = self._motion.hold(obs, refused(error))
            del info[INTERVENTION]  # the safe action is not the operator's
            info |= {SAFE: why.reason, CAUSE: why.cause}
            self._rebase_leader(action)
        return Act(action.copy(), info=info)

    def _rebase_leader(self, last: np.ndarray | None) -> None:
        """Report to the operator's device that its action was not executed (see `Leader`)."""
        rebase = getattr(self.control.leader, "rebase", None)
        if rebase is not None:
            rebase(last)

    def _policy_act(self, obs: Obs, tick: int) -> Act:
        """Return the policy's action, or the safe one if that is missing or rejected."""
        control_held = self.control.held
        step = None if control_held is not None else self._next()
        why = control_held or (STALE if self._is_old(self._captured(obs)) else self._reason)
        timing: dict[str, Any] = {}
        is_not_expected = control_held is not None or why is STALE or self._begins_again
        if step is not None or not is_not_expected:
            timing[IN_TIME] = step is not None

        if step is not None:
            try:
                action, rows = self._motion.follow(self._plan, obs)
            except InvalidAction as error:
                self._plan.drop()  # the other rows assume the result of this action
                self._begins_again = True
                why = refused(error)
                if not self._motion.can_hold:
                    raise
            else:
                act = step.played(action, tick, self._silent_s())
                act.info.update(timing)
                if not rows:  # on the way to the row
                    return replace(act, done=False)
                self._plan.advance()
                return act

        if control_held is not None and self.control.running:  # the loop commands nothing
            action = np.zeros(0, np.float32)
        else:
            try:
                action, why = self._motion.hold(obs, why)
            except InvalidAction:
                # The loop commands nothing to a robot that stands, such as one whose grippers'
                # openings are unknown.
                if self._motion.begun or not self.control.running or not self._motion.can_hold:
                    raise
                action = np.zeros(0, np.float32)
            if control_held is not None:  # the policy's action will not be executed
                self._record_replacement(action)
        info = {SAFE: why.reason, CAUSE: why.cause, SILENT: self._silent_s(), **timing}
        return Act(action, info=info)

    def _begin_again(self, why: Held) -> None:
        """Drop the plan and the pending answer, and wait for the answer to a new observation."""
        self._plan.drop()
        self._drops_answer = True
        self._begins_again = True
        self._reason = why

    def _silent_s(self) -> float:
        return 0.0 if self._waiting_since is None else time.monotonic() - self._waiting_since
