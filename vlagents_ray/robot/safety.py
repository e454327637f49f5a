"""What stands between a policy and a robot's motors."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError, InvalidAction


class Guard:
    """Lets an action through or raises `InvalidAction`; never changes one, as a clipped action is another motion.

    Checked are shape and dimension, that all numbers are finite, the contract's bounds and one's own (`low`,
    `high`: a number, or (D,) for each column), and with `max_step` (likewise) how far an action may be from the
    one before it, for absolute targets.
    """

    def __init__(
        self,
        contract: Contract | None = None,
        *,
        low: float | np.ndarray | None = None,
        high: float | np.ndarray | None = None,
        max_step: float | np.ndarray | None = None,
    ) -> None:
        spec = contract.action if contract is not None else ActionSpec()
        self._dim = spec.dim
        self._low = _bounds("low", max, spec.low, low)
        self._high = _bounds("high", min, spec.high, high)
        self._max_step = None if max_step is None else np.asarray(max_step, np.float64)
        if self._max_step is not None and not (self._max_step >= 0).all():  # with NaN any step would pass
            raise ConfigError(f"max_step: got {max_step}, want 0 or above, or None")

    def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        """`action`, (D,) float32, if it may reach the robot; `last` is what was commanded before."""
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
                raise InvalidAction(f"action[{i}]: got {action[i]:g}, {name} the limit {limit:g}; see the contract")
        if self._max_step is not None and last is not None:
            excess = np.abs(action.astype(np.float64) - last) - self._max_step
            if (excess > 0).any():
                i = int(np.argmax(excess))
                raise InvalidAction(
                    f"action[{i}]: got {action[i]:g} after {last[i]:g}, a larger step than max_step allows"
                )
        return action


def _bounds(
    name: str, stricter: Callable[[float, float], float], stated: float | None, own: float | np.ndarray | None
) -> np.ndarray | None:
    """The stricter of both, as float32, in which actions come: 0.1 is let through where the bound is 0.1."""
    given = [np.asarray(one, np.float32) for one in (stated, own) if one is not None]
    if not given:
        return None
    if any(np.isnan(one).any() for one in given):
        raise ConfigError(f"{name}: got {own}, want numbers")
    return given[0] if len(given) == 1 else np.vectorize(stricter, otypes=[np.float32])(*given)


class Watchdog:
    """Calls `stop(reason)` once when something has been silent for too long, and again after it was heard meanwhile.

        Watchdog(robot.stop, {"server": 1.0, "loop": 0.2})  # s

    It has a thread of its own, so that it also barks when the control loop hangs; `stop` is called on that
    thread. Watching begins at `start` (or `with`), and a source counts as heard then. An error that `stop`
    raises is kept in `error`, and the watchdog goes on watching.
    """

    def __init__(self, stop: Callable[[str], None], silent_s: Mapping[str, float]) -> None:
        for name, limit_s in silent_s.items():
            if not limit_s > 0:
                raise ConfigError(f"watchdog: got {limit_s} s for {name!r}, want above 0")
        self.barks: list[str] = []  # the reasons given to `stop`
        self.error: Exception | None = None
        self._stop = stop
        self._limits = dict(silent_s)
        self._heard = dict.fromkeys(silent_s, 0.0)
        self._barked: set[str] = set()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def heard(self, name: str, ago_s: float = 0.0) -> None:
        """`name` was heard `ago_s` seconds ago; one that is not watched is ignored."""
        at = time.monotonic() - ago_s
        heard = self._heard.get(name)
        if heard is None or at <= heard:
            return
        with self._changed:
            self._heard[name] = at
            if name in self._barked and ago_s < self._limits[name]:
                self._barked.discard(name)
                self._changed.notify_all()

    @property
    def silent(self) -> list[str]:
        """What it barked about and has not heard since."""
        with self._changed:
            return sorted(self._barked)

    def start(self) -> None:
        """Watch from now on."""
        with self._changed:
            if self._thread is not None:
                return
            self._heard = dict.fromkeys(self._limits, time.monotonic())
            self._barked.clear()
            self._thread = threading.Thread(target=self._watch, name="vlagents-ray-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Watch no more. A `stop` under way is waited for."""
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
                    waiting = {n: self._heard[n] + s - now for n, s in self._limits.items() if n not in self._barked}
                    name = min(waiting, key=lambda n: waiting[n]) if waiting else None
                    if name is not None and waiting[name] <= 0:
                        self._barked.add(name)
                        reason = f"{name}: silent for {now - self._heard[name]:.2f} s"
                    else:
                        self._changed.wait(None if name is None else waiting[name])
            self.barks.append(reason)
            try:
                self._stop(reason)
            except Exception as error:  # noqa: BLE001 - the next silence must be noticed too
                self.error = error
