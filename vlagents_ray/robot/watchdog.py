"""The watchdog: a thread that stops a robot when the server or the control loop is silent."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping

from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.errors import ConfigError


class Watchdog:
    """A thread that stops the robot when a source, such as the server or the control loop, is
    silent for too long.

        Watchdog(robot.stop, {"server": 1.0, "loop": 0.2})  # s

    `stop` is called once for each silence, on the watchdog's own thread, which also detects a
    control loop that hangs. The time limits begin to run at `start` (or `with`). After a stop,
    `control.stopped` is true until `restart` is called, also in later runs of the control loop. If
    `stop` raises an exception, the exception is stored in `error`, and the watchdog continues.

    Args:
        stop: Stops the robot; its argument is the reason as text, which is also appended to
            `barks`.
        silent_s: The longest silence of each source by name, s.
        silence_ended: Called on the watchdog's own thread with the name of a source whose silence
            stopped the robot, when the source gives signs of life again.

    Raises:
        ConfigError: A time limit is not above 0.
    """

    def __init__(
        self,
        stop: Callable[[str], None],
        silent_s: Mapping[str, float],
        silence_ended: Callable[[str], None] | None = None,
    ) -> None:
        for name, limit_s in silent_s.items():
            if not limit_s > 0:
                raise ConfigError(f"watchdog: {name!r}: expected a limit above 0 s, got {limit_s}")
        self.barks: list[str] = []  # the reasons passed to `stop`
        self.error: Exception | None = None
        self.control = RobotControl()
        """The state of the robot; in `run_loop`, the watchdog and a chunk player share it."""
        self._stop = stop
        self._silence_ended = silence_ended
        # Sources whose silence has ended, for the calls of `silence_ended`.
        self._heard_again: list[str] = []
        self._limits = dict(silent_s)  # s
        # Time of each source's last sign of life, time.monotonic().
        self._heard_at = dict.fromkeys(silent_s, 0.0)
        self._changed = threading.Condition()  # reentrant
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
            raise ConfigError(
                f"heard: {name!r}: expected a finite number of seconds of 0 or more, got {ago_s}"
            )
        heard_at = time.monotonic() - ago_s
        last_heard_at = self._heard_at.get(name)
        if last_heard_at is None or heard_at <= last_heard_at:
            return

        with self._changed:
            self._heard_at[name] = heard_at
            if name in self.control.silent and ago_s < self._limits[name]:
                self.control.heard(name)
                self._heard_again.append(name)
                self._changed.notify_all()

    def share(self, control: RobotControl) -> None:
        """Use the `RobotControl` of a chunk player from now on, and copy earlier stops to it."""
        with self._changed:
            if control is not self.control:
                control.adopt(self.control)
                self.control = control

    def trip(self, reason: str) -> None:
        """Stop the robot now, on the caller's thread; only `restart` allows motion again."""
        with self._changed:
            self.control.stop(reason)
        self.barks.append(reason)
        with self.control.stopping():
            self._stop(reason)

    def restart(self) -> bool:
        """Allow motion again after a stop; may be called from any thread and from a signal handler.

        Returns:
            Whether motion is allowed. Motion is not allowed while a source is silent
            (`control.silent`): call this again later.
        """
        with self._changed:
            return self.control.restart()

    def start(self) -> None:
        """Start the thread and the time limits of all sources, unless they are running. Earlier
        stops and silences remain in effect.
        """
        with self._changed:
            if self._thread is not None:
                return
            self._heard_at = dict.fromkeys(self._limits, time.monotonic())
            for name in set(self.control.silent) - self._limits.keys():
                # The source is no longer watched, so no sign of life would end its silence.
                self.control.heard(name)
            self._thread = threading.Thread(
                target=self._watch, name="vlagents-ray-watchdog", daemon=True
            )
        self._thread.start()

    def close(self) -> None:
        """End the thread; wait for a running call of `stop`."""
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

    def overdue(self) -> tuple[str | None, float | None]:
        """Record the silence of a source whose time limit has passed.

        Returns:
            The reason for `bark`, or None if no source is overdue; and the time until the next time
            limit may pass, s, or None if no source is watched now.
        """
        with self._changed:
            now = time.monotonic()
            silent = self.control.silent
            left_s: dict[str, float] = {}
            for name, limit_s in self._limits.items():
                if name not in silent:
                    left_s[name] = self._heard_at[name] + limit_s - now
            if not left_s:
                return None, None

            name = min(left_s, key=lambda source: left_s[source])
            if left_s[name] > 0:
                return None, left_s[name]

            reason = f"{name}: silent for {now - self._heard_at[name]:.2f} s"
            self.control.stop(reason, silent=name)
            return reason, None

    def bark(self, reason: str) -> None:
        """Stop the robot for a reason, and store an error that `stop` raises in `error`."""
        self.barks.append(reason)
        try:
            with self.control.stopping():
                self._stop(reason)
        except Exception as error:  # noqa: BLE001 - the next silence must stop the robot as well
            self.error = error

    def _watch(self) -> None:
        """Stop the robot at each silence, until the watchdog is closed."""
        me = threading.current_thread()
        while True:
            with self._changed:
                reason = None
                while reason is None and not self._heard_again:
                    if self._thread is not me:
                        return
                    reason, wait_s = self.overdue()
                    if reason is None:
                        self._changed.wait(wait_s)
                sources, self._heard_again = self._heard_again, []
            if reason is not None:
                self.bark(reason)
            for source in sources:
                self._report_end(source)

    def _report_end(self, source: str) -> None:
        """Report the end of a silence, and store an error of the function that receives it."""
        if self._silence_ended is None:
            return
        try:
            self._silence_ended(source)
        except Exception as error:  # noqa: BLE001 - the watchdog must continue
            self.error = error
