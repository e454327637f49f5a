"""A topic as a part of the observation."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from vlagents_ray.chunking.capture_clock import CaptureClock
from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.robot.ros import messages
from vlagents_ray.robot.ros.settings import COMPRESSED, IMAGE, JOINT_STATE, POSES, InputTopic

logger = logging.getLogger(__name__)


class TopicReader:
    """The newest readable message of a topic, as one part of the observation."""

    def __init__(self, reading: InputTopic, by_stamp: bool) -> None:
        self.topic = reading.topic
        self.value: Any = None  # None before the first message
        self.captured_at = 0.0  # s since 1970
        self.unreadable = 0  # messages
        self._read = _read(reading)
        self._by_stamp = by_stamp
        self._clock = CaptureClock()
        self._seen_at = -math.inf  # s of `time.monotonic`
        self._lock = threading.Lock()  # a watchdog that stops the robot reads where it is, beside the control loop
        self._came: tuple[Any, float] | None = None
        self._looked_at: tuple[Any, float] | None = None

    def take(self, message: Any) -> None:
        """Note a message; on the link's thread. It is read only if it is the newest when the control loop looks."""
        self._came = message, time.time()

    def refresh(self) -> None:
        """Read the newest message, if there is one. One that cannot be read counts as not sent, so the reading ages."""
        with self._lock:
            came = self._came
            if came is not None and came is not self._looked_at:
                self._looked_at = came
                self._read_message(*came)

    def _read_message(self, message: Any, arrived_at: float) -> None:
        try:
            value = self._read(message)
            at = (messages.stamp(message) if self._by_stamp else None) or arrived_at
        except VLAgentsError as error:
            self.unreadable += 1
            if self.value is None:
                raise ConfigError(f"{self.topic}: {error}") from error
            if self.unreadable == 1:
                logger.warning("%s: a message is left out, as are others like it: %s", self.topic, error)
            return
        self.value, self.captured_at = value, at
        self._seen_at = self._clock(Obs(info={CAPTURED: at}))

    @property
    def age_s(self) -> float:
        """How old the reading is, s; infinite if its time lies in the future, as its age is then unknown."""
        return time.monotonic() - self._seen_at


def _read(reading: InputTopic) -> Callable[[Any], Any]:
    """Return the function that reads a message of a topic."""
    if reading.type == IMAGE:
        return messages.image
    if reading.type == COMPRESSED:
        return messages.compressed_image
    if reading.open is not None and reading.closed is not None:
        return lambda message: _opening(reading, message)
    return lambda message: _state(reading, message)


def _state(reading: InputTopic, message: Any) -> np.ndarray:
    if reading.type == JOINT_STATE:
        return messages.joints(message, reading.names, reading.values)
    return messages.pose(message, reading.rotation) if reading.type in POSES else messages.numbers(message)


def _opening(reading: InputTopic, message: Any) -> float:
    """Return how far the gripper is open, 0 to 1, by the first number of a message."""
    first = float(_state(reading, message)[0])
    share = (first - (reading.closed or 0.0)) / ((reading.open or 0.0) - (reading.closed or 0.0))
    return min(1.0, max(0.0, share))
