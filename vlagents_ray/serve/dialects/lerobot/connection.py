"""One LeRobot client: its robot, its newest observation, and its session."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from vlagents_ray.errors import InvalidInput, NotReset
from vlagents_ray.interface import Obs
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.dialects.gateway_sessions import GatewaySessions
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.wire import lerobot
from vlagents_ray.wire.lerobot import PolicyInstructions, RobotObservation
from vlagents_ray.wire.mapping import KeyMapping

logger = logging.getLogger(__name__)

_WAIT_S = 2.0  # time for which a request for actions waits for an observation, as at LeRobot's own server
_HZ = 30.0  # rate of the actions' time stamps if the policy's contract states none, as at LeRobot's own server


@dataclass(slots=True)
class _Waiting:
    """An observation that the policy did not get yet."""

    seen: RobotObservation
    obs: Obs
    instruction: str | None
    admission: MessageAdmission


class LeRobotConnection:
    """One client, from its `Ready` on. Its requests come on several threads; the session is used by one at a time."""

    def __init__(self, context: GatewayContext, mapping: KeyMapping, checkpoint: str | None) -> None:
        self._context = context
        self._mapping = mapping
        self._checkpoint = checkpoint
        self._session = GatewaySessions(context.connect, context.contract)
        self._session.show(NoKey.OPEN, None)  # the protocol has no key, and the deployment accepted that
        self._robot: PolicyInstructions | None = None
        self._acted = -1  # time step of the last observation that the policy got
        self._waiting: _Waiting | None = None
        self._arrival = threading.Condition()
        self._acting = threading.Lock()
        self._requests = 0  # number of requests without a reply
        self._used = time.monotonic()
        self._ended = False

    @property
    def begun(self) -> bool:
        """Whether the client has a session."""
        return self._session.begun

    def quiet_s(self, now: float) -> float:
        """Return the time since the client's last request, s; 0 while it waits for a reply."""
        return 0.0 if self._requests else now - self._used

    def refusal(self) -> str | None:
        """Return None, as the client has no key that could become invalid."""
        return None

    @contextmanager
    def request(self) -> Iterator[None]:
        """Count a request as without a reply."""
        with self._arrival:
            self._requests += 1
        try:
            yield
        finally:
            with self._arrival:
                self._requests -= 1
                self._used = time.monotonic()

    def set_up(self, robot: PolicyInstructions) -> None:
        """Take the policy instructions; raise `InvalidInput` for another checkpoint than the deployment's."""
        if self._checkpoint not in (None, robot.checkpoint):
            raise InvalidInput(
                f"pretrained_name_or_path: got {robot.checkpoint[:80]!r}, this server acts for {self._checkpoint!r}; "
                "start the client with that"
            )
        logger.info("lerobot: a client of %r %r begins", robot.policy_type[:80], robot.checkpoint[:80])
        self._robot = robot

    def observe(self, data: bytes, admission: MessageAdmission) -> None:
        """Take an observation in place of an earlier one that the policy did not get yet.

        One of a time step that the policy got already is left out, unless the client has no action left.

        Args:
            data: The pickle.
            admission: The admission of the message, which is released when the observation is dropped or acted on.
        """
        if self._robot is None:
            raise NotReset("SendPolicyInstructions: got none since Ready; start the client again")
        admission.begin("act")
        seen = lerobot.read_observation(data, admission)
        if seen.timestep <= self._acted and not seen.must_go:
            return
        theirs = lerobot.frame(seen, self._robot)
        obs, instruction = self._mapping.obs(theirs, self._context.limits, self._context.contract)
        if not self._session.begun:
            self._mapping.warn_of_unread_cameras(theirs, "lerobot")
        with self._arrival:
            earlier, self._waiting = self._waiting, _Waiting(seen, obs, instruction, admission)
            self._arrival.notify()
        if earlier is not None:
            earlier.admission.release()

    def actions(self) -> bytes | None:
        """Return the pickle of the actions for the newest observation; None if there is none for two seconds."""
        deadline = time.monotonic() + _WAIT_S
        if not self._acting.acquire(timeout=_WAIT_S):
            return None
        try:
            waiting = self._next(deadline)
            return None if waiting is None else self._act(waiting)
        finally:
            self._acting.release()
            if self._ended:
                self.end()

    def end(self) -> None:
        """End the client's session, after the current request."""
        with self._arrival:
            self._ended = True
            self._waiting = None
            self._arrival.notify_all()
        if self._acting.acquire(blocking=False):
            try:
                self._session.close()
            except Exception:
                logger.exception("lerobot: a session did not end")
            finally:
                self._acting.release()

    def _next(self, deadline: float) -> _Waiting | None:
        with self._arrival:
            self._arrival.wait_for(lambda: self._waiting or self._ended, deadline - time.monotonic())
            waiting, self._waiting = self._waiting, None
        return None if self._ended else waiting

    def _act(self, waiting: _Waiting) -> bytes:
        robot, contract, seen = self._robot, self._context.contract, waiting.seen
        if robot is None:
            raise NotReset("SendPolicyInstructions: got none since Ready; start the client again")
        before, self._acted = self._acted, max(self._acted, seen.timestep)
        try:
            act = self._session.act(waiting.obs, waiting.instruction)
        except BaseException:
            self._acted = before  # the client's next observation of this time step is not left out
            raise
        finally:
            waiting.admission.release()
        rows: np.ndarray = self._mapping.rows(act.action, None if contract is None else contract.action)
        hz = (contract and contract.control_hz) or _HZ
        return lerobot.write_chunk(rows[: robot.actions_per_chunk], seen.timestamp, seen.timestep, 1 / hz)
