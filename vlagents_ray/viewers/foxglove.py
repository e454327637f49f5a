"""Episodes for Foxglove (https://foxglove.dev): `.mcap` files, or a server that it connects to; extra "foxglove"."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require
from vlagents_ray.viewers.viewer import ViewerFrame

LIVE = "ws://127.0.0.1:8765"  # where Foxglove looks by default


class FoxgloveRecordings:
    """Writes an MCAP file of each episode, or serves the running episode to viewers.

    Cameras are `/cameras/NAME` (`foxglove.CompressedImage`), notes `/log` (`foxglove.Log`). All else is JSON: `/state`
    has a list for each part, `/action` the lists `executed` and `planned`, `/chunk` its `rows`, `/timing` the times and
    other numbers by name; each has the `tick`.
    """

    name = "foxglove"
    closing_s: float | None = None  # its server drops what a slow viewer does not take

    def __init__(self, target: str | Path) -> None:
        """Write `TARGET/EPISODE.mcap`, or listen at the address `target` ("ws://HOST:PORT")."""
        self.target = str(target)
        self._foxglove = require("foxglove")
        self._live: tuple[Any, _Topics] | None = None  # the server, and the topics of all episodes
        if self.target.startswith("ws://"):
            self._live = self._listening()
        else:
            Path(target).mkdir(parents=True, exist_ok=True)

    def begin(self, name: str, instruction: str) -> FoxgloveEpisode:
        if self._live is not None:
            return FoxgloveEpisode(self._live[1], None)
        context = self._foxglove.Context()
        file = self._foxglove.open_mcap(Path(self.target) / f"{name}.mcap", context=context, allow_overwrite=True)
        file.write_metadata("episode", {"name": name, "instruction": instruction})
        return FoxgloveEpisode(_Topics(context), file)

    def close(self) -> None:
        if self._live is not None:
            self._live[0].stop()

    def _listening(self) -> tuple[Any, _Topics]:
        host, _, port = self.target.removeprefix("ws://").rpartition(":")
        if not host or not port.isdigit():
            raise ConfigError(f"foxglove: got {self.target!r}, want ws://HOST:PORT, e.g. {LIVE}")
        context = self._foxglove.Context()
        try:
            server = self._foxglove.start_server(name="vlagents_ray", host=host, port=int(port), context=context)
        except Exception as error:  # its own class of error is not public
            raise ConfigError(f"foxglove: cannot listen at {self.target}: {error}; choose another port") from error
        return server, _Topics(context)


class FoxgloveEpisode:
    """The messages of one episode."""

    def __init__(self, topics: _Topics, file: Any | None) -> None:
        self._topics = topics
        self._file = file  # None for a live episode

    def write(self, frame: ViewerFrame) -> None:
        tick, at = {"tick": frame.tick}, round(frame.time * 1e9)
        for name, data in frame.images().items():
            self._topics.log_image(f"/cameras/{name}", data, at)
        if frame.state:
            self._topics.log("/state", tick | {name: part.tolist() for name, part in frame.state.items()}, at)
        actions = {"executed": frame.executed, "planned": frame.planned}
        if known := {name: action.tolist() for name, action in actions.items() if action is not None}:
            self._topics.log("/action", tick | known, at)
        if frame.chunk is not None:
            self._topics.log("/chunk", tick | {"rows": frame.chunk.tolist()}, at)
        if frame.numbers:
            self._topics.log("/timing", tick | dict(frame.numbers), at)
        if frame.note:
            self._topics.log_warning(frame.note, at)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


class _Topics:
    """The channels of a context, each opened with its first message."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._foxglove, self._messages = require("foxglove"), require("foxglove.messages")
        self._channels: dict[str, Any] = {}

    def log(self, topic: str, message: dict[str, Any], at: int) -> None:
        """Log a message in JSON, at a time in ns since 1970."""
        if topic not in self._channels:
            schema = {"type": "object", "title": f"vlagents_ray{topic.replace('/', '.')}"}
            self._channels[topic] = self._foxglove.Channel(topic, schema=schema, context=self._context)
        self._channels[topic].log(message, log_time=at)

    def log_image(self, topic: str, data: bytes, at: int) -> None:
        kind = "jpeg" if data[:3] == b"\xff\xd8\xff" else "png"
        message = self._messages.CompressedImage(
            timestamp=self._timestamp(at), frame_id=topic.rpartition("/")[2], data=data, format=kind
        )
        self._typed(topic, "CompressedImageChannel").log(message, log_time=at)

    def log_warning(self, text: str, at: int) -> None:
        level = self._messages.LogLevel.Warning
        message = self._messages.Log(timestamp=self._timestamp(at), level=level, message=text, name="vlagents_ray")
        self._typed("/log", "LogChannel").log(message, log_time=at)

    def _typed(self, topic: str, kind: str) -> Any:
        if topic not in self._channels:
            self._channels[topic] = getattr(require("foxglove.channels"), kind)(topic, context=self._context)
        return self._channels[topic]

    def _timestamp(self, at: int) -> Any:
        return self._messages.Timestamp(sec=at // 10**9, nsec=at % 10**9)
