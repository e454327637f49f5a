"""A robot with two models: a slow planner chooses the subtask, and a fast policy executes it.

The planner is a policy in another deployment, with a separate session. Here it is part of the
robot, like a slow sensor: each observation contains the planner's newest answer. Thus the policy of
the control loop, with its guard and its watchdog, is the only agent that moves the robot.
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vlagents_ray.abilities import ReadsSlo, ability
from vlagents_ray.chunking.buffer import stamped
from vlagents_ray.chunking.player import AsyncCaller
from vlagents_ray.chunking.timeliness import Timeliness
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, InvalidAction, VLAgentsError, shown
from vlagents_ray.interface import (
    DEADLINE,
    FURTHER_MODEL,
    GOAL,
    IN_TIME,
    SLACK,
    SLO,
    SUBTASK,
    SUBTASK_AGE,
    TICKS,
    Act,
    Agent,
    Obs,
    copied,
)
from vlagents_ray.robot.loop import Robot
from vlagents_ray.robot.wrapper import RobotWrapper
from vlagents_ray.slo import Slo
from vlagents_ray.validation import check_action

if TYPE_CHECKING:
    from typing_extensions import Self

logger = logging.getLogger(__name__)


class RobotWithPlanner(RobotWrapper):
    """A robot whose observations contain the newest answer of a planner.

    Use it as a context manager around each episode; outside the context it behaves like the inner
    robot. Entering the context waits for the planner's first answer. Afterwards, the robot sends an
    observation to the planner `hz` times per second in the background, so that no tick waits for
    the planner. `observe` adds to the observation's info:

    - `goal`: the action of the planner's answer, (D,) float32;
    - `subtask`: the text `subtask` in the planner's `Act.info`, if there is one;
    - `subtask_age_ms`: the time since the observation from which the answer was computed.

    While the planner is late or down, its last answer remains in use. When this answer is older
    than `max_age_s`, `holds` becomes the reason, so that the control loop holds the robot until
    there is a newer answer.

    Args:
        robot: The robot, which the caller opens and closes.
        planner: The planner, such as a `RemoteAgent`; leaving the context closes it. It returns one
            action, (D,); only the first row of a chunk is used.
        instruction: The task in words, for the planner.
        hz: The rate of requests to the planner, Hz; at most one request is pending.
        max_age_s: The largest age of an answer that the policy may use, s; at least one period of
            the planner.

    Raises:
        ConfigError: A number is out of range.
    """

    def __init__(
        self,
        robot: Robot,
        planner: Agent,
        *,
        instruction: str | None = None,
        hz: float = 1.0,
        max_age_s: float = 5.0,
    ) -> None:
        super().__init__(robot)
        if not (math.isfinite(hz) and hz > 0):
            raise ConfigError(f"hz: expected a rate of the planner above 0 Hz, got {hz}")
        if not max_age_s >= 1 / hz:
            raise ConfigError(
                f"max_age_s: expected at least the period of the planner, {1 / hz:g} s, got "
                f"{max_age_s}; otherwise the robot holds between any two answers"
            )
        self._planner = planner
        self._instruction = instruction
        self._hz, self._period_s = hz, 1 / hz
        self._max_age_s = max_age_s
        self._caller: AsyncCaller | None = None  # None outside the context
        self._contract: Contract | None = None
        self._begin()

    def _begin(self) -> None:
        self._timeliness = Timeliness()
        self._asked_s = 0.0  # time of the observation of the last request
        self._due_s = 0.0  # time of the next request
        self._answer: dict[str, Any] = {}  # the newest answer, as the info of an observation
        self._seen_s = 0.0  # time of the observation of the newest answer
        self._failure = ""  # reason why the last request has no answer; empty if it has an answer
        self._task_done = False

    @property
    def task_done(self) -> bool:
        """Whether the planner considers the task finished, for `run_loop(until=...)`."""
        return self._task_done

    @property
    def planner_timeliness(self) -> Timeliness:
        """The share of the planner's ticks, `hz` per second, at which the answer to the previous
        tick's request had arrived.
        """
        return self._timeliness

    def __enter__(self) -> Self:
        """Begin the planner's episode, and wait for its first answer.

        Raises:
            VLAgentsError: The planner cannot be reached, or fails; the message begins with
                "planner".
        """
        self._begin()
        with contextlib.ExitStack() as stack:
            stack.callback(self._planner.close)
            self._asked_s = time.monotonic()
            obs = stamped(self._robot.observe(), {})
            try:
                self._planner.initialize()
                self._contract = self._planner.contract
                self._reset(obs)
                self._take(self._planner.act(obs))
            except VLAgentsError as error:
                error.args = (f"planner: {error}",)
                raise
            self._caller = AsyncCaller(self._planner)  # closing the caller closes the planner
            stack.pop_all()
        self._due_s = self._asked_s + self._period_s
        return self

    def __exit__(self, *exc: object) -> None:
        if self._caller is not None:
            self._caller.close()
            self._caller = None

    def observe(self) -> Obs:
        """Return the robot's observation with the planner's newest answer; send the planner's next
        request if it is due.
        """
        observed_s = time.monotonic()
        obs = self._robot.observe()
        caller = self._caller
        if caller is None:
            return obs

        self._receive(caller)
        if observed_s >= self._due_s:
            self._ask(caller, obs, observed_s)
        age_ms = 1e3 * self._age_s()
        return replace(obs, info={**obs.info, **self._answer, SUBTASK_AGE: age_ms})

    def __getattr__(self, name: str) -> Any:
        # This is not a property, since a robot without `holds` must not have this attribute while
        # it may move.
        if name == "holds":
            reason = self._reason_to_hold()
            if reason is not None:
                return reason
        return super().__getattr__(name)

    def _reset(self, obs: Obs) -> None:
        """Begin the planner's episode; log a warning if the server cannot serve the planner in
        time.
        """
        options: dict[str, Any] = {}
        reads = ability(self._planner, ReadsSlo)
        if reads is not None and reads.reads_slo:
            slo = Slo(self._hz, age_ms=1e3 * self._max_age_s, rows=1)
            options[SLO] = slo.to_json()
        answer = self._planner.reset(obs, self._instruction, **options).get(SLO) or {}
        if not answer.get("in_time", True):
            logger.warning("planner: slo: %s", answer.get("reason"))

    def _receive(self, caller: AsyncCaller) -> None:
        """Process the planner's answer or error, if one has arrived."""
        answer = caller.take()
        if answer is None:
            return
        if isinstance(answer, Act):
            try:
                self._take(answer)
            except InvalidAction as error:
                self._fail(error)
        else:
            self._timeliness.failed(answer)
            self._fail(answer)

    def _take(self, act: Act) -> None:
        """Check an answer of the planner, and store it as the newest answer."""
        goal = Act(check_action(act.action, self._contract)).rows()[0]
        answer: dict[str, Any] = {GOAL: goal}
        subtask = act.info.get(SUBTASK)
        if subtask is not None:
            if not isinstance(subtask, str):
                raise InvalidAction(
                    f"info[{SUBTASK!r}]: expected a text, got {shown(subtask)}; correct the "
                    "planner, or leave the entry out"
                )
            answer[SUBTASK] = subtask
        self._answer = answer
        self._seen_s = self._asked_s
        self._failure = ""
        self._task_done = act.done

    def _fail(self, error: Exception) -> None:
        code = error.code if isinstance(error, VLAgentsError) else type(error).__name__
        if not self._failure:  # otherwise the failure is already logged
            logger.warning("planner: %s: %s; the last subtask stays", code, error)
        self._failure = f"{code}: {error}"

    def _ask(self, caller: AsyncCaller, obs: Obs, now: float) -> None:
        """Count a tick of the planner, and send an observation to the planner unless the last
        request is still pending.
        """
        is_answered = caller.idle and not self._failure
        self._timeliness.count({IN_TIME: is_answered})
        # Ticks that the control loop has missed are not repeated.
        passed = math.floor((now - self._due_s) / self._period_s)
        self._due_s += (passed + 1) * self._period_s
        if not caller.idle:
            return

        self._asked_s = now
        request = {
            # An answer after this deadline would be too old to be used.
            DEADLINE: 1e3 * self._max_age_s,
            SLACK: 1e3 * self._period_s,
            TICKS: self._timeliness.report(),
            FURTHER_MODEL: True,  # the server of the policy already counts this robot
        }
        caller.ask(stamped(copied(obs), request))

    def _age_s(self) -> float:
        return time.monotonic() - self._seen_s

    def _reason_to_hold(self) -> str | None:
        """Return the reason why the policy may not use the planner's last answer, or None."""
        if self._caller is None:
            return None
        age_s = self._age_s()
        if age_s <= self._max_age_s:
            return None
        why = self._failure or "the planner has not answered yet"
        return (
            f"planner: expected a subtask of at most {self._max_age_s:g} s, got a subtask of "
            f"{age_s:.1f} s: {why}; see the planner's server, or raise max_age_s"
        )
