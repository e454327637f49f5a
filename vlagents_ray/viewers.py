"""Output of episodes to Rerun (https://rerun.io), as `.rrd` files or in a running viewer; needs the
extra "rerun".

A separate thread writes the frames, and drops frames that arrive too fast, so that the control loop
is never delayed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.interface import (
    AGE,
    CAPTURED,
    INTERVENTION,
    PLANNED,
    SAFE,
    SILENT,
    WANTED,
    Act,
    Obs,
)
from vlagents_ray.registry import require

__all__ = ["EpisodeViewer", "ViewerFrame", "open_viewer"]

logger = logging.getLogger(__name__)
LIVE = "rerun+http://127.0.0.1:9876/proxy"  # the default address of `rerun`, the viewer
_PORT = 9876
CLOSING_S = 2.0  # time limit for a live viewer to receive the remaining frames
FRAMES = 100  # size of the queue in frames: 2 s at 50 Hz, 180 MB with two cameras of 640x480
_NICE = 5  # niceness of the writing thread, so that its priority is lower than the loop's


@dataclass(frozen=True, slots=True)
class ViewerFrame:
    """An observation, the chunk that was planned from it, and the action that was executed next.

    The arrays must not change later.
    """

    tick: int  # tick of the episode
    time: float  # time of the observation, s since 1970
    cameras: Mapping[str, np.ndarray] = field(default_factory=dict)  # (H, W, 3) uint8 RGB
    # (D,) float32 by name; the gripper is also a part.
    state: Mapping[str, np.ndarray] = field(default_factory=dict)
    executed: np.ndarray | None = None  # (D,) float32
    planned: np.ndarray | None = None  # (D,) float32, the row of the newest chunk for this tick
    chunk: np.ndarray | None = None  # (H, D) float32, if a new chunk begins
    numbers: Mapping[str, float] = field(default_factory=dict)  # times and other numbers, by name
    note: str = ""  # a message to show, such as why the action is a safe one

    @classmethod
    def from_obs(cls, obs: Obs, tick: int, **fields: Any) -> ViewerFrame:
        """Make a frame from an observation.

        Args:
            obs: The observation, whose arrays are copied.
            tick: The tick of the episode.
            fields: Further fields.

        Returns:
            The frame. Its time is `info["captured_at"]` if the observation has that key, else the
            current time.
        """
        state = {name: np.array(values) for name, values in obs.state.items()}
        if obs.gripper is not None:
            state["gripper"] = np.array([obs.gripper], np.float32)
        cameras = {name: np.array(image) for name, image in obs.cameras.items()}
        return cls(
            tick,
            **{"time": obs.info.get(CAPTURED, time.time()), **fields},
            cameras=cameras,
            state=state,
        )


class RerunRecordings:
    """Writes one Rerun recording for each episode, on the timelines `tick` and `time`.

    The entities are `cameras/NAME`, `state/NAME` for each part of the state, `action/executed`,
    `action/planned` and `action/chunk`, `timing/NAME` for times and other numbers, and `log` for
    notes.
    """

    def __init__(self, target: str) -> None:
        """Write files `TARGET/EPISODE.rrd`, or send episodes to the viewer at an address; see
        `open_viewer`.
        """
        is_live = target == "live" or target.startswith("rerun+")
        if "://" in target and not is_live:
            raise ConfigError(
                f"rerun: expected a folder, 'live', or an address such as {LIVE}, got {target!r}"
            )
        self.target = LIVE if target == "live" else target
        self._rerun = require("rerun")
        self._folder = None if is_live else Path(target)
        self.closing_s = CLOSING_S if self._folder is None else None
        """Time limit, s, for writing the remaining frames when the recordings are closed; None for
        no limit.
        """

        if self._folder is None:
            self._require_listener()
            # By default the SDK waits forever for a viewer that has ended.
            self._rerun.unregister_shutdown()
        else:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(
                    f"viewer {target}: expected a folder that can be written to, got {error}"
                ) from error

    def _require_listener(self) -> None:
        """Raise `ConfigError` if nothing listens at the address, since the SDK would retry
        forever.
        """
        address = urlsplit(self.target)
        try:
            host, port = address.hostname or "", address.port or _PORT
            socket.create_connection((host, port), CLOSING_S).close()
        except OSError as error:
            raise ConfigError(
                f"rerun: no viewer listens at {self.target}: {error}; start it with `rerun`"
            ) from error

    def begin(self, name: str, instruction: str) -> RerunEpisode:
        """Begin an episode.

        `name` is also the name of its file, and an empty `instruction` is not shown.
        """
        recording = self._rerun.RecordingStream("vlagents_ray", recording_id=uuid4())
        if self._folder is None:
            recording.connect_grpc(self.target)
        else:
            recording.save(self._folder / f"{name}.rrd")
        recording.send_recording_name(name)
        return RerunEpisode(self._rerun, recording, instruction, live=self._folder is None)


class RerunEpisode:
    """Writes the frames of one episode to a recording."""

    def __init__(self, rerun: Any, recording: Any, instruction: str, *, live: bool) -> None:
        self._rerun, self._recording, self._live = rerun, recording, live
        if instruction:
            recording.log("instruction", rerun.TextDocument(instruction), static=True)

    def write(self, frame: ViewerFrame) -> None:
        """Write a frame."""
        rerun, recording = self._rerun, self._recording
        recording.set_time("tick", sequence=frame.tick)
        recording.set_time("time", timestamp=frame.time)

        for name, image in frame.cameras.items():
            picture = rerun.EncodedImage(contents=encode_jpeg(image), media_type="image/jpeg")
            recording.log(["cameras", name], picture)
        for name, values in frame.state.items():
            recording.log(["state", name], rerun.Scalars(values))

        for name, action in (("executed", frame.executed), ("planned", frame.planned)):
            if action is not None:
                recording.log(["action", name], rerun.Scalars(action))
        if frame.chunk is not None:
            chunk = np.asarray(frame.chunk, np.float32)
            recording.log(["action", "chunk"], rerun.Tensor(chunk, dim_names=("row", "dimension")))

        for name, value in frame.numbers.items():
            recording.log(["timing", name], rerun.Scalars(value))
        if frame.note:
            recording.log("log", rerun.TextLog(frame.note, level="WARN"))

    def close(self) -> None:
        """End the recording."""
        if self._live:
            self._recording.flush(timeout_sec=CLOSING_S)
        self._recording.disconnect()


def open_viewer(target: str) -> EpisodeViewer:
    """Open a viewer.

    Args:
        target: A folder for `.rrd` files; the address of a viewer, "rerun+http://HOST:PORT/proxy";
            or "live", the viewer on this machine.

    Returns:
        The viewer, which the caller closes.

    Raises:
        ConfigError: The target is not a valid address, or nothing listens at the address.
        MissingDependency: The extra "rerun" is not installed.
    """
    return EpisodeViewer(RerunRecordings(target))


class EpisodeViewer:
    """Shows episodes on its own thread.

        with open_viewer("recordings") as viewer:
            with viewer.episode("stack_0", "stack the cups"):
                viewer.add(ViewerFrame.from_obs(obs, tick=0, executed=action))

    `add` puts the frame into a queue and returns. If the queue is full, because the disk or a live
    viewer is slow, the frame is dropped and counted in `dropped`. If writing fails, the remaining
    frames of the episode are not shown; the error is logged and stored in `error`.

    Args:
        target: The folder or the address to which episodes are written; see `open_viewer`.
        frames: The largest number of frames in the queue.
    """

    def __init__(self, target: RerunRecordings, *, frames: int = FRAMES) -> None:
        self.dropped = 0  # the number of dropped frames
        self.episodes = 0  # the number of episodes written without an error
        self.error: Exception | None = None  # the first error
        self._recordings = target
        self._frames = frames
        self._queue: queue.SimpleQueue[ViewerFrame | tuple[str, str] | None] = queue.SimpleQueue()
        self._added = 0  # the number of frames added, counted by the caller's thread
        self._written = 0  # the number of frames written, counted by the writing thread
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="vlagents-ray-rerun", daemon=True)
        self._thread.start()

    @property
    def has_room(self) -> bool:
        """Whether a frame added now would be shown."""
        return self._added - self._written < self._frames

    @contextlib.contextmanager
    def episode(self, name: str, instruction: str = "") -> Iterator[None]:
        """Show the frames that are added within the context as one episode, even if the context
        ends with an exception.

        Args:
            name: The name of the episode, and of its file.
            instruction: The task in words.
        """
        self._queue.put((name, instruction))
        try:
            yield
        finally:
            self._queue.put(None)

    def add(self, frame: ViewerFrame) -> None:
        """Add a frame to the queue without waiting."""
        if not self.has_room:
            self.dropped += 1
            return
        self._added += 1
        self._queue.put(frame)

    def close(self) -> None:
        """Write the queued frames, and close the target.

        A live viewer has two seconds to receive them.
        """
        if not self._closed:
            self._closed = True
            self._queue.put(None)
            self._thread.join(self._recordings.closing_s)
            if self._thread.is_alive():
                self.error = self.error or TimeoutError(
                    f"no viewer at {self._recordings.target} accepts the remaining frames"
                )

    def report(self) -> str:
        """Return a line with the number of episodes shown and frames dropped."""
        line = (
            f"rerun: {self.episodes} episodes in {self._recordings.target}, {self.dropped} "
            "frames dropped"
        )
        if self.error is None:
            return line
        return f"{line}; stopped by {type(self.error).__name__}: {self.error}"

    def __enter__(self) -> EpisodeViewer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)

        while True:
            item = self._queue.get()
            if not isinstance(item, tuple):
                break
            name, instruction = item
            frames = self._frames_of_episode()
            try:
                with contextlib.closing(self._recordings.begin(name, instruction)) as writer:
                    for frame in frames:
                        writer.write(frame)
                self.episodes += 1
            except Exception as error:  # noqa: BLE001 - the run continues without the viewer
                logger.warning("rerun: episode %s is not shown: %s", name, error)
                self.error = self.error or error
            for _ in frames:  # drop the frames that were not written
                pass

    def _frames_of_episode(self) -> Iterator[ViewerFrame]:
        """Yield the queued frames until the end of the episode."""
        while True:
            frame = self._queue.get()
            if not isinstance(frame, ViewerFrame):
                return
            yield frame
            self._written += 1


class LoopView:
    """Shows the episodes of one run in a viewer; does nothing if there is no viewer."""

    def __init__(self, viewer: EpisodeViewer | None) -> None:
        self._viewer = viewer
        self._chunk: np.ndarray | None = None  # chunk that was shown last
        self._note = ""

    def episode(self, instruction: str) -> contextlib.AbstractContextManager[None]:
        """Show the frames added within the context as one episode, whose name is the present time
        (UTC).
        """
        if self._viewer is None:
            return contextlib.nullcontext()
        now = time.time()
        name = f"{time.strftime('%Y%m%d_%H%M%S', time.gmtime(now))}_{int(now * 1e3) % 1000:03d}"
        return self._viewer.episode(name, instruction)

    def add(
        self,
        obs: Obs,
        act: Act,
        executed: np.ndarray | None,
        tick: int,
        work_s: float,
        stop: str = "",
    ) -> None:
        """Show a tick with `work_s`, the computing time of the loop, and the reason of a stop;
        never waits.
        """
        viewer = self._viewer
        if viewer is None:
            return
        if not viewer.has_room:
            viewer.dropped += 1
            return

        info = act.info
        rows = info.get(PLANNED)
        note = stop or str(info.get(SAFE, ""))
        numbers: dict[str, float] = dict(info.get("timing") or {})
        numbers |= {name: float(info[name]) for name in (AGE, SILENT) if name in info}
        numbers["work_ms"] = work_s * 1e3
        numbers["safe"] = float(SAFE in info)
        numbers["intervention"] = float(INTERVENTION in info)
        numbers["stopped"] = float(bool(stop))

        frame = ViewerFrame.from_obs(
            obs,
            tick,
            executed=None if executed is None else np.array(executed),
            planned=info.get(WANTED) if rows is None else rows[info["row"]],
            chunk=None if rows is self._chunk else rows,
            numbers=numbers,
            note=note if note != self._note else "",
        )
        if rows is not None:
            self._chunk = rows
        self._note = note
        viewer.add(frame)
