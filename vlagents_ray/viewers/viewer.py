"""A viewer of episodes, which never delays what it shows."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from vlagents_ray.viewers.frame import ViewerFrame

if TYPE_CHECKING:
    from typing_extensions import Self

logger = logging.getLogger(__name__)

FRAMES = 100  # in the queue: 2 s at 50 Hz, 180 MB with two cameras of 640x480
_NICE = 5  # the writing thread runs after the loop's


class ViewerEpisode(Protocol):
    """Writes one episode."""

    def write(self, frame: ViewerFrame) -> None:
        """Write a frame."""
        ...

    def close(self) -> None:
        """Finish the episode."""
        ...


class EpisodeFormat(Protocol):
    """Where episodes are written to, and how."""

    name: str  # of the viewer
    target: str  # the folder or the address
    closing_s: float | None  # how long the end waits for what is left to be written; None: until it is

    def begin(self, name: str, instruction: str) -> ViewerEpisode:
        """Begin an episode; `name` is also that of its file."""
        ...

    def close(self) -> None:
        """Free what the episodes shared, such as a server."""
        ...


@dataclass(frozen=True, slots=True)
class _Beginning:
    name: str
    instruction: str


class EpisodeViewer:
    """Shows episodes, on a thread of its own.

        with EpisodeViewer(RerunRecordings("recordings")) as viewer:
            with viewer.episode("stack_0", "stack the cups"):
                viewer.add(ViewerFrame.of(obs, tick=0, executed=action))

    `add` puts the frame into a queue and returns. If the queue is full, because the disk or the other side of a live
    connection is slow, the frame is dropped and counted in `dropped`. If writing fails, the rest of the episode is not
    shown; the error is logged, and kept in `error`.

    Args:
        target: Where episodes are written to.
        frames: The largest number of frames in the queue.
    """

    def __init__(self, target: EpisodeFormat, *, frames: int = FRAMES) -> None:
        self.dropped = 0  # frames
        self.episodes = 0  # written without an error
        self.error: Exception | None = None  # the first one
        self._format = target
        self._frames = frames
        self._queue: queue.SimpleQueue[ViewerFrame | _Beginning | None] = queue.SimpleQueue()
        self._put = 0  # frames added, counted by the caller's thread
        self._got = 0  # frames written, counted by the writing thread
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"vlagents-ray-{target.name}", daemon=True)
        self._thread.start()

    @property
    def has_room(self) -> bool:
        """Whether a frame that is added now is shown."""
        return self._put - self._got < self._frames

    @contextlib.contextmanager
    def episode(self, name: str, instruction: str = "") -> Iterator[None]:
        """Make the frames that are added within the context one episode, however the context ends.

        Args:
            name: The name of the episode, and of its file.
            instruction: The task in words.
        """
        self._queue.put(_Beginning(name, instruction))
        try:
            yield
        finally:
            self._queue.put(None)

    def add(self, frame: ViewerFrame) -> None:
        """Show a frame; never waits."""
        if not self.has_room:
            self.dropped += 1
            return
        self._put += 1
        self._queue.put(frame)

    def close(self) -> None:
        """Write the frames in the queue, and close the target; a live viewer gets two seconds for them."""
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join(self._format.closing_s)
            if self._thread.is_alive():
                self.error = self.error or TimeoutError(f"nothing at {self._format.target} takes what is left")
                return
            self._format.close()

    def report(self) -> str:
        """Return a line that says what was shown."""
        line = f"{self._format.name}: {self.episodes} episodes in {self._format.target}, {self.dropped} frames dropped"
        return line if self.error is None else f"{line}; stopped by {type(self.error).__name__}: {self.error}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while isinstance(item := self._queue.get(), _Beginning):
            self._show(item)

    def _show(self, beginning: _Beginning) -> None:
        frames = self._until_the_end()
        try:
            with contextlib.closing(self._format.begin(beginning.name, beginning.instruction)) as writer:
                for frame in frames:
                    writer.write(frame)
            self.episodes += 1
        except Exception as error:  # noqa: BLE001 - what is shown goes on without the viewer
            logger.warning("%s: episode %s is not shown: %s", self._format.name, beginning.name, error)
            self.error = self.error or error
        for _ in frames:
            pass

    def _until_the_end(self) -> Iterator[ViewerFrame]:
        """Yield the frames of an episode as they come."""
        while isinstance(frame := self._queue.get(), ViewerFrame):
            yield frame
            self._got += 1
