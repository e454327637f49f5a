"""Viewers of episodes: what they show, and the thread that shows it, which drops what comes too fast."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import AGE, CAPTURED, INTERVENTION, PLANNED, SAFE, SILENT, WANTED, Act, Obs

if TYPE_CHECKING:
    from typing_extensions import Self


logger = logging.getLogger(__name__)
FRAMES = 100  # in the queue: 2 s at 50 Hz, 180 MB with two cameras of 640x480
_NICE = 5  # the writing thread runs after the loop's


@dataclass(frozen=True, slots=True)
class ViewerFrame:
    """An observation, what was planned from it and executed after it. The caller does not change its arrays later."""

    tick: int  # of the episode
    time: float  # s since 1970, of the observation
    cameras: Mapping[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 RGB
    files: Mapping[str, bytes] = field(default_factory=dict)  # JPEG or PNG files of cameras that are not in `cameras`
    state: Mapping[str, np.ndarray] = field(default_factory=dict)  # (D,) float32; the gripper is a part
    executed: np.ndarray | None = None  # (D,) float32
    planned: np.ndarray | None = None  # (D,) float32: what the newest chunk says of this tick
    chunk: np.ndarray | None = None  # (H, D) float32, where a new one begins
    numbers: Mapping[str, float] = field(default_factory=dict)  # times and whatever else is a number, by name
    note: str = ""  # what a person should read, such as why the action is a safe one

    @classmethod
    def of(cls, obs: Obs, tick: int, **what: Any) -> ViewerFrame:
        """Make a frame of an observation.

        Args:
            obs: The observation, whose arrays are copied.
            tick: The tick of the episode.
            what: Further fields.

        Returns:
            The frame, with the time of `info["captured_at"]` if the observation states it, else now.
        """
        state = {name: np.array(part) for name, part in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        cameras = {name: np.array(image) for name, image in obs.cameras.items()}
        return cls(tick, **{"time": obs.info.get(CAPTURED, time.time()), **what}, cameras=cameras, state=state)

    def images(self) -> dict[str, bytes]:
        """Return a JPEG or PNG file for each camera."""
        return {**self.files, **{name: encode_jpeg(image) for name, image in self.cameras.items()}}


def numbers_of(info: Mapping[str, Any]) -> dict[str, float]:
    """Return what the info of an `Act` says in numbers that viewers show: its timing, and that of a chunk player."""
    timing = info.get("timing") or {}
    return {**timing, **{name: float(info[name]) for name in (AGE, SILENT) if name in info}}


def note_of(info: Mapping[str, Any]) -> str:
    """Return why the action of an `Act` is a safe one; "" if it is the policy's."""
    return str(info.get(SAFE, ""))


class ViewerEpisode(Protocol):
    """Writes one episode."""

    def write(self, frame: ViewerFrame) -> None:
        """Write a frame."""

    def close(self) -> None:
        """Finish the episode."""


class EpisodeFormat(Protocol):
    """Where episodes are written to, and how."""

    name: str  # of the viewer
    target: str  # the folder or the address
    closing_s: float | None  # how long the end waits for what is left to be written; None: until it is

    def begin(self, name: str, instruction: str) -> ViewerEpisode:
        """Begin an episode; `name` is also that of its file."""

    def close(self) -> None:
        """Free what the episodes shared, such as a server."""


@dataclass(frozen=True, slots=True)
class _Beginning:
    name: str
    instruction: str


class EpisodeViewer:
    """Shows episodes on its own thread.

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


class LoopView:
    """Shows one run in each of some viewers; without one, it costs nothing."""

    def __init__(self, viewers: Sequence[EpisodeViewer]) -> None:
        """Show a run in `viewers`."""
        self._viewers = viewers
        self._chunk: np.ndarray | None = None  # the last one that was shown
        self._note = ""

    @contextlib.contextmanager
    def episode(self, instruction: str) -> Iterator[None]:
        """Show what is added within the context as one episode."""
        name = dated_name()
        with contextlib.ExitStack() as stack:
            for viewer in self._viewers:
                stack.enter_context(viewer.episode(name, instruction))
            yield

    def add(self, obs: Obs, act: Act, executed: np.ndarray | None, tick: int, work_s: float, stop: str = "") -> None:
        """Show a tick; never waits."""
        if not any(viewer.has_room for viewer in self._viewers):
            for viewer in self._viewers:
                viewer.dropped += 1
            return
        info = act.info
        rows, note = info.get(PLANNED), stop or note_of(info)
        spells = {"safe": SAFE in info, "intervention": INTERVENTION in info, "stopped": bool(stop)}
        frame = ViewerFrame.of(
            obs,
            tick,
            executed=None if executed is None else np.array(executed),
            planned=info.get(WANTED) if rows is None else rows[info["row"]],
            chunk=None if rows is self._chunk else rows,
            numbers={**numbers_of(info), "work_ms": work_s * 1e3, **{name: float(on) for name, on in spells.items()}},
            note=note if note != self._note else "",
        )
        self._chunk, self._note = self._chunk if rows is None else rows, note
        for viewer in self._viewers:
            viewer.add(frame)


def dated_name(when: float | None = None) -> str:
    """Return a name for an episode that begins now, or at a time in s since 1970: 20270131_183000_250 (UTC)."""
    when = time.time() if when is None else when
    return f"{time.strftime('%Y%m%d_%H%M%S', time.gmtime(when))}_{int(when * 1e3) % 1000:03d}"
