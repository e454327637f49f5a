"""The chunk player: one action per tick from a policy's chunks, without blocking a control loop."""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np

from vlagents_ray.abilities import HasStatistics, Observes, ability
from vlagents_ray.chunking.buffer import (
    ENSEMBLE,
    ENSEMBLE_M,
    CaptureClock,
    Chunk,
    ChunkBuffer,
    DelayEstimate,
    Merge,
    Mode,
    Origin,
    Step,
    stamped,
)
from vlagents_ray.chunking.careful import FRESH_GRIP, CarefulRows
from vlagents_ray.chunking.control import Leader, RobotControl
from vlagents_ray.chunking.fallback import (
    CAREFUL,
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
    TICKS,
    WANTED,
    Act,
    Agent,
    Obs,
    copied,
)
from vlagents_ray.validation import check_action

_CLOSE_S = 2.0
# The largest number of actions between two requests that are recorded as replacements of the
# policy's actions.
_MAX_REPLACEMENTS = 256
_TIMED_TICKS = 10  # number of recent ticks from which the period of the loop is computed
_KEPT_WIRE = 0.9  # factor by which the longest transfer time decreases with each answer
_LONGEST_REPLAN_MS = 1e9  # longest delay of a request that a server may require, ms


class AsyncCaller:
    """A thread that calls `agent.act`, so that the caller's own thread never waits for it.

    Only one thread may use the caller, and nothing else may use the agent during a request.
    `settle` waits for the end of the request.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._jobs: queue.SimpleQueue[Obs | None] = queue.SimpleQueue()  # None ends the thread
        self._answers: queue.SimpleQueue[Act | Exception] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-caller", daemon=True)
        self._thread.start()
        self.idle = True
        """Whether there is neither a request in progress nor an answer that `take` has not
        returned yet.
        """

    @property
    def busy(self) -> bool:
        """Whether a request is in progress."""
        return not self.idle and self._answers.empty()

    def ask(self, obs: Obs) -> None:
        """Begin a request, which is allowed only while `idle`.

        `obs` must not be changed afterwards.
        """
        self.idle = False
        self._jobs.put(obs)

    def take(self, wait_s: float = 0.0) -> Act | Exception | None:
        """Return the policy's answer or error; None if there is none within `wait_s` seconds."""
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
        """Close the agent as soon as its request is over, and wait at most two seconds for this."""
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

    tick: int = -1  # tick of the request's observation
    # `ChunkBuffer.executed` at the request's observation: the position of the answer's first row.
    step: int = 0
    seen_at: float = 0.0  # capture time of the observation, s of `time.monotonic`
    origin: Origin | None = None  # pose at the observation; None before the first request


@dataclass(frozen=True)
class PlayerSettings:
    """The settings of a `ChunkPlayer`: when it sends requests to the policy, and how it uses the
    answers.

    Raises:
        ConfigError: A setting is out of range, or settings contradict each other.
    """

    mode: Mode = "open_loop"
    """With "open_loop", the player executes `execute` rows, then sends a request and waits for the
    answer.

    With "ensemble", it sends a request at each tick, and averages the actions of all chunks with
    the weights exp(-m * i), oldest first (ACT's temporal ensembling). With "async", it sends
    requests in the background, one at a time, with the newest observation.
    """
    # The number of rows of a chunk between two requests (default: all); in "async", the number of
    # ticks between two requests (default: 1).
    execute: int | None = None
    merge: str | Merge = "newest"
    """The method that combines the rows of several chunks for one tick in "async".

    It is "newest", "average", "weighted_average", "conservative", "ensemble", or a function (see
    `vlagents_ray.chunking.buffer`).
    """
    ensemble_m: float = ENSEMBLE_M  # m of the weights of "ensemble"
    real_time_chunking: bool = False
    """Whether each request contains the remaining plan and the measured delay (`LEFTOVER`, `DELAY`
    in `vlagents_ray.interface`), for policies that use them.

    It requires "async".
    """
    # Time limit of `act`; default: 0 in "async", otherwise no limit.
    deadline_s: float | None = None
    timeout_s: float | None = None  # time limit of a request; default: the limit of the agent
    # The largest number of rows of a chunk that are executed. A chunk with `done` is executed
    # completely.
    horizon: int | None = None
    max_age_s: float | None = None
    """The largest age of the observation of an executed action.

    The age is the time since `info["captured_at"]`, which is the time of the sensor that was read
    first, or since the call of `act` (see `CaptureClock`).
    """
    safe: Safe = "auto"  # action that replaces a missing one (see `SafeAction`)
    fresh_grip: int | None = FRESH_GRIP
    """The age, in rows, from which the observation of a row is too old to open or close a gripper.

    Before such a row, the robot stands and waits for the answer to a new observation (see
    `vlagents_ray.chunking.careful`). The setting has an effect if the measured delay of answers is
    at least as long. None: the robot never waits.
    """

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ConfigError(f"mode: expected one of {list(get_args(Mode))}, got {self.mode!r}")
        for name, value in (
            ("execute", self.execute),
            ("horizon", self.horizon),
            ("fresh_grip", self.fresh_grip),
        ):
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
    """An `Agent` around another agent, local or remote, whose `act` returns single actions, (D,),
    one per control tick.

    Each call of `act` is a tick. Row r of a chunk is to be executed after r further actions since
    the chunk's observation, whenever the chunk arrives. Rows whose step was already executed are
    skipped. While the robot holds still, no row is skipped (see
    `vlagents_ray.chunking.buffer.ChunkBuffer`). `reset` may block: it begins the episode and, with
    a deadline, waits for the first chunk.

    In mode "async", and in the other modes with `deadline_s`, `act` returns within `deadline_s`. It
    returns the policy's action, or the `safe` action if the policy's action is missing. The reason
    is then in `act.info["safe"]`, and its kind in `act.info["safe_cause"]`. `info` also has
    `age_ticks`, `chunk`, `row`, and `silent_s`, the time since the oldest unanswered request. The
    next `act` raises errors that another request cannot cure: `InvalidInput`, and errors of other
    packages. After other errors, safe actions are returned until the policy answers. Without a
    deadline, all errors are raised.
    """

    statistics: dict[str, Any] | None = None
    """The ranges of values in the policy's training, once the policy is initialized; see
    `HasStatistics`.
    """

    control: RobotControl
    """The state of the robot, which selects the source of motion at each `act`."""

    timeliness: Timeliness
    """The share of the episode's ticks that had an action of the policy in time."""

    rows: int
    """The number of rows of the plan that were executed completely in the episode."""

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
            settings: When requests are sent, and how answers are used; default: `PlayerSettings()`.
            check: Checks every action before it is returned, such as a `vlagents_ray.robot.Guard`.
                If the check rejects an action of the policy, the safe action is returned instead,
                and the plan is dropped. If it rejects a safe action, the last action is returned if
                repeating it holds the robot still; otherwise `act` raises `InvalidAction`. The
                check also receives the last action. If there is no last action, and after safe
                actions, a `Guard` with `measure` uses the measured pose.
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
        self._careful = CarefulRows(self._plan, settings.fresh_grip)
        self._caller: AsyncCaller | None = None
        self._contract: Contract | None = None
        self._arm: ActionSpec | None = None  # the actions of the arm's contract
        self._delay = DelayEstimate()
        self._begin()

    def _begin(self) -> None:
        self._plan.drop()
        self._careful.forget()
        self._careful_ticks = 0  # the number of ticks for which the robot has been standing
        self._tick: int | None = None  # tick of the next `act`; None outside of an episode
        self._request = _Request()  # the last request
        self._drops_answer = False  # whether the answer to the last request must not be executed
        # The actions, (D,), that replaced the policy's actions since the last request.
        self._replacements = deque[np.ndarray](maxlen=_MAX_REPLACEMENTS)
        self._is_replaced = False  # whether the policy's action of this tick was replaced
        self._was_operated = False  # whether an operator moved the robot at the last tick
        self._chunks = 0  # the number of answers
        self.rows = 0
        self._ticks_of_rows = 0  # the number of ticks at which a row, or a part of it, was executed
        # The time at which the oldest unanswered request was sent, s of `time.monotonic`; None if
        # there is none.
        self._waiting_since: float | None = None
        self._reason = WAITING  # reason why the plan has no row, if it has none
        # Whether the policy has not yet answered since the plan was dropped. The plan is dropped if
        # the robot is stopped or moved, or if the guard rejects a row.
        self._begins_again = False
        self.timeliness = Timeliness()
        # Age of the last row that was executed since the last request.
        self._executed_age_ms: float | None = None
        # The begin times of the last ticks, s of `time.monotonic`.
        self._tick_begins: deque[float] = deque(maxlen=_TIMED_TICKS)
        self._wire_ms = 0.0  # longest recent transfer time of a request and its answer, ms
        self._inference_ms = 0.0  # duration of the last batch, ms
        # The time before which the server needs no further request, s of `time.monotonic`.
        self._replan_at = 0.0
        self._captured = CaptureClock()
        self._motion = Motion(self.check)

    @property
    def contract(self) -> Contract | None:
        """The policy's contract, with single actions."""
        # During an episode the policy is busy, and a call of a remote policy might block.
        if self._tick is None:
            self._contract = self._agent.contract
        return None if self._contract is None else replace(self._contract, chunk=1)

    def initialize(self) -> None:
        """Initialize the policy.

        A request in progress is awaited first, if the policy was used before.
        """
        if self._caller is not None:
            self._caller.settle()
        self._agent.initialize()
        trained_on = ability(self._agent, HasStatistics)
        self.statistics = None if trained_on is None else trained_on.statistics
        self._choose_safe()

    def join(self, arm: ActionSpec) -> None:
        """Join the arm's description of its columns to the policy's, before a `reset`.

        The arm may know grippers that the policy's contract does not declare. The check, such as a
        `vlagents_ray.robot.Guard`, and the operator's device get the same description.

        Args:
            arm: The actions of the robot's contract.

        Raises:
            ConfigError: The descriptions contradict each other.
        """
        self._arm = arm
        for part in (self.check, self.control.leader):
            join = getattr(part, "join", None)
            if join is not None:
                join(arm)

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode, without a time limit. The plan and pending requests are dropped."""
        if self._caller is not None:
            self._caller.settle()
        self._begin()
        obs = stamped(obs, {})
        self._captured(obs)  # called before the reset of the policy, which may take long
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
    def rows_per_tick(self) -> float | None:
        """The number of rows of the plan per tick with a row in this episode: 1 at full speed, less
        during an ease-in (`vlagents_ray.chunking.ease`); None without such a tick.
        """
        return self.rows / self._ticks_of_rows if self._ticks_of_rows else None

    def interrupt(self) -> None:
        """Drop the plan after the robot was stopped or moved, and did not execute the last action
        of `act`.

        Answers to earlier observations are discarded, and a new request is sent to the policy.
        `run_loop` calls this method at each tick at which it holds the robot. Call it in your own
        loop when you stop the robot or take it over.
        """
        self._begin_again(STOPPED)
        if self._is_replaced:  # The replacing action was not executed.
            self._replacements.pop()
            self._is_replaced = False
        self._motion.stop()
        self._rebase_leader(None)

    def observe(self, obs: Obs, action: np.ndarray | None = None) -> None:
        """Pass an observation to the policy without requesting an action.

        Args:
            obs: The observation.
            action: The action that the robot executed instead of the policy's action, (D,), if your
                own loop chose it. It counts as a tick, and the next request contains it (`EXECUTED`
                in `vlagents_ray.interface`).

        Raises:
            InvalidAction: The check rejects the action.
        """
        if self._caller is not None:
            self._caller.settle()
        observes = ability(self._agent, Observes)
        if observes is not None:
            observes.observe(obs)
        if action is not None and self._tick is not None:
            executed = self._motion.move(action, obs)
            self._record_replacement(executed)
            self._plan.advance(executed)
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
            self._was_operated = False
            act = self._policy_act(obs, tick)
            self.timeliness.count(act.info)
            self._executed_age_ms = act.info.get(AGE_MS, self._executed_age_ms)
            return act
        if not self._was_operated:
            self._begin_takeover()
        self._was_operated = True
        act = self._operator_act(obs)
        if SAFE not in act.info:  # The operator's action replaces a row.
            self._record_replacement(act.action)
            self._plan.advance(act.action)
        return act

    def close(self) -> None:
        """Close the policy, immediately or as soon as the request in progress is over."""
        if self._caller is not None:
            self._caller.close()
            self._caller = None
        else:
            self._agent.close()
        self._begin()

    def _update_plan(self, obs: Obs, tick: int, begun: float) -> None:
        """Receive the policy's answer, send the next request if it is due, and wait for an answer
        if necessary, within the deadline.
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
            if not is_of_this_tick and self._next() is not None and not self._stands():
                break
            self._receive(caller.take(left_s), tick)

    def _choose_safe(self) -> None:
        """Choose the safe action; raises `ConfigError` if it does not fit the policy's actions."""
        self._contract = self._agent.contract
        spec = ActionSpec() if self._contract is None else self._contract.action
        safe: SafeAction | None = None
        if self.settings.deadline_s is not None or self.control.leader is not None:
            safe = SafeAction(self.settings.safe, spec, self._arm)
        bounds = getattr(self.check, "bounds", (None, None))
        self._plan.describe(spec, self._arm, bounds=bounds)
        self._motion = Motion(self.check, self._contract, safe, self._arm)

    def _record_replacement(self, action: np.ndarray) -> None:
        """Record an action that replaces the policy's action."""
        self._replacements.append(action)
        self._is_replaced = True

    def _record_request(self, tick: int, obs: Obs) -> None:
        """Record that a request with this tick's observation is being sent."""
        step, origin = self._plan.executed, self._plan.origin()
        self._request = _Request(tick, step, self._captured(obs), origin)
        self._drops_answer = self._motion.keeps(self._plan)

    def _is_old(self, seen_at: float) -> bool:
        max_age_s = self.settings.max_age_s
        return max_age_s is not None and seen_at < time.monotonic() - max_age_s

    def _next(self) -> Step | None:
        """Return the current step of the plan, from chunks whose observations are recent enough."""
        max_age_s = self.settings.max_age_s
        if max_age_s is not None and self._plan.drop(time.monotonic() - max_age_s):
            self._reason = OLD
        return self._plan.next

    def _stands(self) -> bool:
        """Return whether the robot waits for a new answer before it moves a gripper."""
        if self.control.state != "autonomous":
            return False
        return self._careful.stands(self._motion.last, self._delay.ticks)

    def _is_request_due(self, tick: int, obs: Obs) -> bool:
        """Return whether a request with this tick's observation is due."""
        if self._is_old(self._captured(obs)):
            return False
        step = self._next()
        if step is None or step.chunk.done:
            return step is None
        if self._stands():
            return True
        if self.settings.mode == "open_loop":
            return self.settings.execute is not None and step.row >= self.settings.execute

        # An answer with a single action has only a last row.
        is_last_row = step.chunk.end == self._plan.executed + 1
        if is_last_row:
            return True
        if tick - self._request.tick < (self.settings.execute or 1):
            return False
        if time.monotonic() >= self._replan_at:
            return True
        # The request is sent while an urgent request can still be answered in time. The waiting
        # time in the server's queue is not considered: otherwise, robots would send more requests
        # when the queue is longer.
        return self._slack_ms() <= self._inference_ms + 2 * self._period_ms()

    def _receive(self, answer: Act | Exception | None, tick: int) -> None:
        """Add the policy's answer to the plan, if there is an answer.

        Raise errors that another request cannot cure.
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
        """Record the transfer time of an answer, and the time at which the server needs the next
        request.
        """
        timing = answer.info.get("timing")
        if isinstance(timing, Mapping):  # otherwise the agent is not a `RemoteAgent`
            self._wire_ms = max(timing.get("wire_ms", 0.0), _KEPT_WIRE * self._wire_ms)
            self._inference_ms = timing.get("inference_ms", 0.0)
        replan_ms = answer.info.get(REPLAN)
        self._replan_at = 0.0
        if isinstance(replan_ms, (int, float)) and 0 < replan_ms <= _LONGEST_REPLAN_MS:
            self._replan_at = time.monotonic() + replan_ms / 1e3

    def _slack_ms(self) -> float:
        """Return the time, ms, that the server has to answer a request of this tick.

        It ends at the tick after the last remaining row, and excludes the transfer time.
        """
        return max(0.0, self._plan.known * self._period_ms() - self._wire_ms)

    def _period_ms(self) -> float:
        """Return the period of the loop, ms, from its last ticks; 0 before the second tick."""
        intervals_s = sorted(end - begin for begin, end in itertools.pairwise(self._tick_begins))
        return 1e3 * intervals_s[len(intervals_s) // 2] if intervals_s else 0.0

    def _take(self, act: Act) -> None:
        """Add the chunk of an answer to the plan."""
        info = {key: value for key, value in act.info.items() if key not in OF_THE_LOOP}
        rows = Act(check_action(act.action, self._contract)).rows()
        # With `done`, the task ends with the last row of the chunk, so no row is cut off.
        if not act.done:
            rows = rows[: self.settings.horizon]

        tick, step, seen_at, origin = self._request
        chunk = Chunk(self._chunks, step, rows, act.done, info, tick, seen_at, origin)
        awaited = self._careful.awaited(self._motion.last, self._delay.ticks)
        added = self._plan.add(chunk)
        if added:
            self._careful.answered(awaited)
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

        if self._caller is not None:  # without a caller, the robot waits for each answer
            info[SLACK] = self._slack_ms()
            info[TICKS] = self.timeliness.report()
            if self._executed_age_ms is not None:
                info[EXECUTED_AGE] = self._executed_age_ms
                self._executed_age_ms = None

        # While an operator moves the robot, their actions replace the plan.
        if self.settings.real_time_chunking and self.control.state != "human":
            delay = self._careful.rows_ahead(self._motion.last, self._delay.ticks)
            info |= self._plan.continuation(delay)
        return info

    def _operator_act(self, obs: Obs) -> Act:
        """Return the operator's action, or the safe action if the guard rejects it."""
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
            self._plan.move(action)
            del info[INTERVENTION]  # the safe action is not an action of the operator
            info |= {SAFE: why.reason, CAUSE: why.cause}
            self._rebase_leader(action)
        return Act(action.copy(), info=info)

    def _begin_takeover(self) -> None:
        """Report the last command to the operator's device (see `Leader`)."""
        begin = getattr(self.control.leader, "begin", None)
        if begin is not None:
            begin(self._motion.last)

    def _rebase_leader(self, last: np.ndarray | None) -> None:
        """Report to the operator's device that the device's action was not executed (see
        `Leader`).
        """
        rebase = getattr(self.control.leader, "rebase", None)
        if rebase is not None:
            rebase(last)

    def _policy_act(self, obs: Obs, tick: int) -> Act:
        """Return the policy's action, or the safe action if the policy's action is missing or
        rejected.
        """
        control_held = self.control.held
        step = None if control_held is not None else self._next()
        why = control_held or (STALE if self._is_old(self._captured(obs)) else self._reason)
        timing: dict[str, Any] = {}
        is_not_expected = control_held is not None or why is STALE or self._begins_again
        if step is not None or not is_not_expected:
            timing[IN_TIME] = step is not None

        is_standing = step is not None and self._motion.can_hold and self._stands()
        if is_standing:
            why, timing[IN_TIME] = self._standing()
        else:
            self._careful_ticks = 0
        if step is not None and not is_standing:
            try:
                action, rows = self._motion.follow(self._plan, obs)
            except InvalidAction as error:
                self._plan.drop()  # the other rows assume the result of this action
                self._begins_again = True
                why = refused(error)
                if not self._motion.can_hold:
                    raise
            else:
                act = step.with_action(action, tick, self._silent_s())
                act.info.update(timing)
                self._ticks_of_rows += 1
                self.rows += rows
                self._careful.executed(action)
                # Without a row, the command is still approaching it.
                return act if rows else replace(act, done=False)

        if control_held is not None and self.control.running:  # the loop sends no command
            action = np.zeros(0, np.float32)
        else:
            try:
                action, why = self._motion.hold(obs, why)
                self._plan.move(action)
            except InvalidAction:
                # The loop sends no command to a robot at rest without a safe action, for example if
                # its grippers' openings are unknown.
                if self._motion.begun or not self.control.running or not self._motion.can_hold:
                    raise
                action = np.zeros(0, np.float32)
            if control_held is not None:  # The policy's action will not be executed.
                self._record_replacement(action)
        info = {SAFE: why.reason, CAUSE: why.cause, SILENT: self._silent_s(), **timing}
        return Act(action, info=info)

    def _standing(self) -> tuple[Held, bool]:
        """Return why the robot stands before it moves a gripper, and whether it stands by choice.

        The answer to a request in progress and the answer to the next request take twice the
        measured delay. If they take longer, or the server failed, the answer is missing.
        """
        self._careful_ticks += 1
        is_failed = self._reason.cause in ("lost", "failed")
        if is_failed or self._careful_ticks > 2 * self._delay.ticks + 1:
            return self._reason if is_failed else WAITING, False
        return CAREFUL, True

    def _begin_again(self, why: Held) -> None:
        """Drop the plan and the pending answer, and wait for the answer to a new observation."""
        self._plan.drop()
        self._careful.forget()
        self._drops_answer = True
        self._begins_again = True
        self._reason = why

    def _silent_s(self) -> float:
        return 0.0 if self._waiting_since is None else time.monotonic() - self._waiting_since
