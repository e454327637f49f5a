"""Episodes for Rerun (https://rerun.io): `.rrd` files, or a viewer that runs; the extra "rerun"."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require
from vlagents_ray.viewers.viewer import ViewerFrame

APPLICATION = "vlagents_ray"
LIVE = "rerun+http://127.0.0.1:9876/proxy"  # where `rerun`, the viewer, listens by default
CLOSING_S = 2.0  # within which a live viewer takes what is left
_PORT = 9876


class RerunRecordings:
    """Writes a recording of each episode, on the timelines `tick` and `time`.

    Cameras are `cameras/NAME`, parts of the state `state/NAME`, the actions `action/executed`, `action/planned` and
    `action/chunk`, times and other numbers `timing/NAME`, and notes `log`.
    """

    name = "rerun"

    def __init__(self, target: str | Path) -> None:
        """Write `TARGET/EPISODE.rrd`, or send to the viewer at the address `target` ("rerun+http://HOST:PORT/proxy")."""
        self.target = str(target)
        self._rerun = require("rerun")
        self._folder = None if self.target.startswith("rerun+") else Path(target)
        self.closing_s = CLOSING_S if self._folder is None else None
        if self._folder is None:
            _require_viewer(self.target)
            self._rerun.unregister_shutdown()  # it would wait for a viewer that is gone, without an end
        else:
            self._folder.mkdir(parents=True, exist_ok=True)

    def begin(self, name: str, instruction: str) -> RerunEpisode:
        recording = self._rerun.RecordingStream(APPLICATION, recording_id=uuid4())
        if self._folder is None:
            recording.connect_grpc(self.target)
        else:
            recording.save(self._folder / f"{name}.rrd")
        recording.send_recording_name(name)
        return RerunEpisode(self._rerun, recording, instruction, live=self._folder is None)

    def close(self) -> None:
        """Do nothing: recordings share nothing."""


class RerunEpisode:
    """The recording of one episode."""

    def __init__(self, rerun: Any, recording: Any, instruction: str, *, live: bool) -> None:
        self._rerun = rerun
        self._recording = recording
        self._live = live
        if instruction:
            recording.log("instruction", rerun.TextDocument(instruction), static=True)

    def write(self, frame: ViewerFrame) -> None:
        rerun, recording = self._rerun, self._recording
        recording.set_time("tick", sequence=frame.tick)
        recording.set_time("time", timestamp=frame.time)
        for name, data in frame.images().items():
            kind = "image/jpeg" if data[:3] == b"\xff\xd8\xff" else "image/png"
            recording.log(["cameras", name], rerun.EncodedImage(contents=data, media_type=kind))
        for name, part in frame.state.items():
            recording.log(["state", name], rerun.Scalars(part))
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
        if self._live:
            self._recording.flush(timeout_sec=CLOSING_S)
        self._recording.disconnect()


def _require_viewer(address: str) -> None:
    """Raise `ConfigError` if nothing listens at the address: the SDK would retry without an end."""
    where = urlsplit(address)
    try:
        with socket.create_connection((where.hostname or "", where.port or _PORT), CLOSING_S):
            pass
    except OSError as error:
        raise ConfigError(f"rerun: no viewer listens at {address}: {error}; start it with `rerun`") from error
