"""Checks between a policy and a robot: a guard for each action, and a watchdog for silence."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from vlagents_ray.chunking.control import Control
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction, MissingState
from vlagents_ray.interface import Obs


class Guard:
    """A check that accepts an action or raises `InvalidAction`; it never clips one, as that would be another motion.

    The guard checks the action's shape, that its numbers are finite and within the bounds, and that an absolute target
    is not too far from the previous one. There is no previous action before the first one, and after a stop the arm
    need not be where the last action commanded it. With `measure` these actions are compared with the measured pose.
    Without it the first action may be anywhere within the bounds, and one after a stop is compared with the last
    action.

    Args:
        contract: The policy's contract, for the action's dimension and bounds; None checks neither.
        low: Lower bound, for all numbers of an action or (D,), in the action's units; the stricter of this and the
            contract's applies.
        high: Upper bound, as `low`.
        max_step: Largest difference between two consecutive actions, for all numbers or (D,); None checks none.
        measure: Returns the measured pose in an observation, (D,) in the action's order and units, e.g.
            `lambda obs: obs.state["joints"]`; not for relative actions.

    Raises:
        ConfigError: A bound is NaN, `max_step` is negative, or `measure` is given for relative actions.
    """

    def __init__(
        self,
        contract: Contract | None = None,
        *,
        low: float | np.ndarray | None = None,
        high: float | np.ndarray | None = None,
        max_step: float | np.ndarray | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
    ) -> None:
        spec = contract.action if contract is not None else ActionSpec()
        self._dim = spec.dim
        self._low = _bounds("low", max, spec.low, low)
        self._high = _bounds("high", min, spec.high, high)
        self._max_step = None if max_step is None else np.asarray(max_step, np.float64)
        if self._max_step is not None and not (self._max_step >= 0).all():  # with NaN any step would pass
            raise ConfigError(f"max_step: got {max_step}, want 0 or above, or None")
        if measure is not None and spec.relative:
            raise ConfigError(
                "measure: got one for relative actions, which cannot be compared with a pose; leave it out"
            )
        self._measure = measure

    def reference(self, obs: Obs, last: np.ndarray | None) -> np.ndarray | None:
        """Return the pose with which the first action, or the first one after a stop, is compared.

        Args:
            obs: The current observation.
            last: The last commanded action, (D,); None before the first one.

        Returns:
            The measured pose, (D,) float32; `last` if the guard has no `measure`.

        Raises:
            ConfigError: `measure` returns another number of values than an action has.
            InvalidAction: `measure` returns NaN or infinity, so that no action can be checked.
        """
        if self._measure is None:
            return last
        pose = np.asarray(self._measure(obs), np.float32)
        wanted = self._dim if last is None else len(last)
        if pose.ndim != 1 or wanted not in (None, len(pose)):
            raise ConfigError(f"measure: got {pose.shape}, want ({wanted or 'D'},), as an action is")
        if not np.isfinite(pose).all():
            raise InvalidAction(f"measure: got {pose.tolist()}, want finite numbers; the robot's sensors are broken")
        return pose

    def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        """Return an action if it may reach the robot.

        Args:
            action: The action, (D,) float32.
            last: The action or pose from which `max_step` counts, (D,); None skips that check.

        Returns:
            The action, unchanged.

        Raises:
            InvalidAction: The action has a wrong shape, is not finite, exceeds a bound, or is too far from `last`.
        """
        action = np.asarray(action)
        if action.ndim != 1 or action.dtype.kind != "f" or self._dim not in (None, len(action)):
            wanted = f"({self._dim if self._dim is not None else 'D'},) float32"
            raise InvalidAction(f"action: got {action.shape} {action.dtype}, want {wanted}, a single row")
        if not np.isfinite(action).all():
            raise InvalidAction(f"action: got {action.tolist()}, want finite numbers; the policy's output is broken")
        for name, bound, wrong in (("below", self._low, np.less), ("above", self._high, np.greater)):
            if bound is not None and (over := wrong(action, bound)).any():
                i = int(np.argmax(over))
                limit = float(np.broadcast_to(bound, action.shape)[i])
                raise InvalidAction(
                    f"action[{i}]: got {action[i]:g}, {name} the limit {limit:g}; see the contract", cause="limits"
                )
        if self._max_step is not None and last is not None:
            if last.shape != action.shape:
                raise InvalidAction(
                    f"action: got {action.shape} after {np.shape(last)}, want as many numbers as before"
                )
            excess = np.abs(action.astype(np.float64) - last) - self._max_step
            if (excess > 0).any():
                i = int(np.argmax(excess))
                raise InvalidAction(
                    f"action[{i}]: got {action[i]:g} after {last[i]:g}, a larger step than max_step allows",
                    cause="max_step",
                )
        return action


def measured_state(part: str | None) -> Callable[[Obs], np.ndarray] | None:
    """Return a `measure` of a `Guard`: a part of the state, such as "joints"; None measures nothing."""

    def measured(obs: Obs) -> np.ndarray:
        if part not in obs.state:
            raise MissingState(str(part), obs.state)
        return obs.state[part]

    return None if part is None else measured


def _bounds(
    name: str, stricter: Callable[[float, float], float], stated: float | None, own: float | np.ndarray | None
) -> np.ndarray | None:
    """Return the stricter of both bounds as float32, the type of actions, so that a bound of 0.1 accepts 0.1."""
    given = [np.asarray(one, np.float32) for one in (stated, own) if one is not None]
    if not given:
        return None
    if any(np.isnan(one).any() for one in given):
        raise ConfigError(f"{name}: got {own}, want numbers")
    return given[0] if len(given) == 1 else np.vectorize(stricter, otypes=[np.float32])(*given)


class Watchdog:
    """A thread that stops the robot when a source, such as the server or the control loop, is silent for too long.

        Watchdog(robot.stop, {"server": 1.0, "loop": 0.2})  # s

    `stop` is called once for each silence, on the watchdog's own thread, which also detects a control loop that hangs.
    The time limits begin to run at `start` (or `with`). After a stop, `control.stopped` is true until `restart` is
    called, also in later runs of the control loop. If `stop` raises an exception, it is kept in `error`, and the
    watchdog continues.

    Args:
        stop: Stops the robot; its argument is the reason as text, which is also appended to `barks`.
        silent_s: The longest silence of each source by name, s.

    Raises:
        ConfigError: A time limit is not above 0.
    """

    def __init__(self, stop: Callable[[str], None], silent_s: Mapping[str, float]) -> None:
        for name, limit_s in silent_s.items():
            if not limit_s > 0:
                raise ConfigError(f"watchdog: got {limit_s} s for {name!r}, want above 0")
        self.barks: list[str] = []  # the reasons given to `stop`
        self.error: Exception | None = None
        self.control = Control()
        """The state of the robot, which `run_loop` lets it share with a chunk player."""
        self._stop = stop
        self._limits = dict(silent_s)
        self._heard = dict.fromkeys(silent_s, 0.0)
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def heard(self, name: str, ago_s: float = 0.0) -> None:
        """Record a sign of life of a source.

        Args:
            name: The source; a name that is not watched is ignored.
            ago_s: The age of the sign, s.

        Raises:
            ConfigError: `ago_s` is negative or not finite.
        """
        if not 0 <= ago_s < math.inf:
            raise ConfigError(f"heard: got {ago_s} s ago for {name!r}, want a finite number from 0")
        at = time.monotonic() - ago_s
        heard = self._heard.get(name)
        if heard is None or at <= heard:
            return
        with self._changed:
            self._heard[name] = at
            if name in self.control.silent and ago_s < self._limits[name]:
                self.control.heard(name)
                self._changed.notify_all()

    def share(self, control: Control) -> None:
        """Use the state of a chunk player, to which earlier stops are moved."""
        with self._changed:
            if control is not self.control:
                control.adopt(self.control)
                self.control = control

    def trip(self, reason: str) -> None:
        """Stop the robot now, on the caller's thread; only `restart` allows motion again."""
        with self._changed:
            self.control.stop(reason)
        self.barks.append(reason)
        self._stop(reason)

    def restart(self) -> bool:
        """Allow motion again after a stop; may be called from any thread and from a signal handler.

        Returns:
            Whether motion is allowed. While a source is silent (`control.silent`), it is not: call this again later.
        """
        with self._changed:
            return self.control.restart()

    def start(self) -> None:
        """Start the thread and the time limits of all sources, unless they run. Stops and silences persist."""
        with self._changed:
            if self._thread is not None:
                return
            self._heard = dict.fromkeys(self._limits, time.monotonic())
            for name in set(self.control.silent) - self._limits.keys():
                self.control.heard(name)  # no later sign of life would end its silence
            self._thread = threading.Thread(target=self._watch, name="vlagents-ray-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, after any running call of `stop`."""
        with self._changed:
            thread, self._thread = self._thread, None
            self._changed.notify_all()
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def __enter__(self) -> Watchdog:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _watch(self) -> None:
        me = threading.current_thread()
        while True:
            with self._changed:
                reason = None
                while reason is None:
                    if self._thread is not me:
                        return
                    now = time.monotonic()
                    silent = self.control.silent
                    waiting = {n: self._heard[n] + s - now for n, s in self._limits.items() if n not in silent}
                    name = min(waiting, key=lambda n: waiting[n]) if waiting else None
                    if name is not None and waiting[name] <= 0:
                        reason = f"{name}: silent for {now - self._heard[name]:.2f} s"
                        self.control.stop(reason, silent=name)
                    else:
                        self._changed.wait(None if name is None else waiting[name])
            self.barks.append(reason)
            try:
                self._stop(reason)
            except Exception as error:  # noqa: BLE001 - the next silence must stop the robot as well
                self.error = error
