"""A recording for Rerun opens with Rerun's own reader, and contains the sent data."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for

from vlagents_ray import ConfigError
from vlagents_ray.errors import MissingDependency
from vlagents_ray.images.jpeg_png import decode
from vlagents_ray.registry import pip_install
from vlagents_ray.serve.ports import free_port
from vlagents_ray.viewers import ViewerFrame, open_viewer

TICKS = 6
_RERUN = {  # component -> its name in this test
    "Scalars:scalars": "values",
    "EncodedImage:blob": "file",
    "TextLog:text": "text",
    "TextDocument:text": "text",
    "Tensor:data": "tensor",
}


def read_rrd(path: Path) -> dict[str, dict[int | None, Any]]:
    """Return the content of a `.rrd` file: entity -> tick (None for static data) -> numbers, an
    image's file, a text, or a tensor's rows.
    """
    from rerun.chunk import RrdReader

    found: dict[str, dict[int | None, Any]] = defaultdict(dict)
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        ticks = (
            batch["tick"].to_pylist() if "tick" in batch.schema.names else [None] * chunk.num_rows
        )
        for column in _RERUN.keys() & set(batch.schema.names):
            for tick, value in zip(ticks, batch[column].to_pylist(), strict=True):
                found[chunk.entity_path.lstrip("/")][tick] = _plain(_RERUN[column], value)
    return dict(found)


def _plain(kind: str, value: Any) -> Any:
    if kind == "values":
        return value
    if kind == "file":
        return bytes(value[0])
    if kind == "text":
        return value[0]
    buffer = value[0]["buffer"]
    numbers = next(iter(buffer.values())) if isinstance(buffer, dict) else buffer
    rows, columns = value[0]["shape"]
    return [numbers[i * columns : (i + 1) * columns] for i in range(rows)]


def frame(tick: int) -> ViewerFrame:
    return ViewerFrame(
        tick,
        1e9 + tick / 50,
        cameras={"left/wrist": np.full((16, 24, 3), 40 * tick, np.uint8)},
        state={
            "joints": np.array([tick, -tick], np.float32),
            "gripper": np.array([0.5], np.float32),
        },
        executed=np.array([tick, 1, 2], np.float32),
        planned=np.array([tick, 1, 3], np.float32),
        chunk=np.arange(12, dtype=np.float32).reshape(4, 3) + tick if tick % 4 == 0 else None,
        numbers={"round_trip_ms": 3.5, "safe": 0.0},
        note="deadline_exceeded" if tick == 2 else "",
    )


@pytest.mark.library("rerun")
def test_a_recording_of_rerun_holds_what_was_sent(tmp_path: Path) -> None:
    with open_viewer(str(tmp_path / "seen")) as viewer, viewer.episode("ep0", "stack the cups"):
        for tick in range(TICKS):
            viewer.add(frame(tick))
    assert (viewer.episodes, viewer.dropped, viewer.error) == (1, 0, None)
    found = read_rrd(tmp_path / "seen/ep0.rrd")
    ticks = range(TICKS)
    assert found["instruction"] == {None: "stack the cups"}
    assert found["state/joints"] == {tick: [tick, -tick] for tick in ticks}
    assert found["state/gripper"] == {tick: [0.5] for tick in ticks}
    assert found["action/executed"] == {tick: [tick, 1, 2] for tick in ticks}
    assert found["action/planned"] == {tick: [tick, 1, 3] for tick in ticks}
    assert found["action/chunk"] == {tick: frame(tick).chunk.tolist() for tick in (0, 4)}
    assert found["timing/round_trip_ms"] == {tick: [3.5] for tick in ticks}
    assert found["log"] == {2: "deadline_exceeded"}
    pictures = found[r"cameras/left\/wrist"]
    assert {tick: decode(data).shape for tick, data in pictures.items()} == dict.fromkeys(
        ticks, (16, 24, 3)
    )
    assert [round(float(decode(pictures[tick]).mean()), -1) for tick in ticks] == [
        40 * tick for tick in ticks
    ]


@pytest.mark.library("rerun")
def test_a_live_viewer_of_rerun_has_to_run() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # the socket does not listen
        with pytest.raises(
            ConfigError, match=r"no viewer listens at rerun\+http.*start it with `rerun`"
        ):
            open_viewer(f"rerun+http://127.0.0.1:{taken.getsockname()[1]}/proxy")


def test_the_address_of_something_else_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"rerun: expected a folder, 'live', or .*, got 'ws://127.0.0.1:1'"
    ):
        open_viewer("ws://127.0.0.1:1")


def test_a_viewer_that_is_not_installed_names_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependency, match=re.escape(pip_install("rerun"))):
        open_viewer(str(tmp_path))


_VIEWER = """
import sys, time, rerun
shown = rerun.RecordingStream("viewer")
shown.serve_grpc(grpc_port=int(sys.argv[1]))
time.sleep(600)
"""


def listens(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def rerun_viewer() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Run a receiver of live recordings like Rerun's viewer; yield its address and its process."""
    port = free_port()
    with subprocess.Popen([sys.executable, "-c", _VIEWER, str(port)]) as process:
        try:
            wait_for(lambda: listens(port))
            yield f"rerun+http://127.0.0.1:{port}/proxy", process
        finally:
            process.kill()


@pytest.mark.library("rerun")
def test_a_viewer_of_rerun_gets_what_runs(
    rerun_viewer: tuple[str, subprocess.Popen[bytes]],
) -> None:
    address, _ = rerun_viewer
    viewer = open_viewer(address)
    with viewer, viewer.episode("ep0", "stack the cups"):
        for tick in range(TICKS):
            viewer.add(frame(tick))
    # `close` has reported no error, so the viewer has received all frames.
    assert (viewer.episodes, viewer.dropped, viewer.error) == (1, 0, None)


@pytest.mark.slow
@pytest.mark.library("rerun")
def test_a_viewer_of_rerun_that_stands_still_holds_up_nothing(
    rerun_viewer: tuple[str, subprocess.Popen[bytes]],
) -> None:
    address, process = rerun_viewer
    viewer = open_viewer(address)
    with viewer.episode("ep0", "stack the cups"):
        process.send_signal(signal.SIGSTOP)
        for tick in range(TICKS):
            viewer.add(frame(tick))
    begun = time.monotonic()
    viewer.close()
    assert time.monotonic() - begun < 30
    assert viewer.episodes == 0
    assert viewer.error is not None
