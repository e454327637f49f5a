"""Opens the observers of a replica by their keys in its settings: `live` and `record`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.observers.live_view import ReplicaView
from vlagents_ray.serve.observers.recording import SessionRecorder, open_recorder


class ReplicaObservers:
    """The observers of one replica, from now on until `close`."""

    def __init__(
        self, engine: Engine, args: ServerArgs, replica: str, node: str, metadata: Callable[[], Mapping[str, Any]]
    ) -> None:
        """Observe the requests of an engine.

        `replica` is Ray's name of the replica, which no other has or will have. Viewers see the name of its `node`.

        Raises:
            ConfigError: A folder cannot be written to.
            MissingDependency: The extra "record" is not installed.
        """
        self._observers = engine.observers
        # What viewers see; its live observer is active only while something reads it.
        self.view = ReplicaView(engine, engine.observers, replica.rpartition("#")[2], node, metadata, args.live)
        self.recorder: SessionRecorder | None = None
        if args.record is not None:
            self.recorder = open_recorder(engine.sessions, args.record, replica, metadata)
            engine.observers.add(self.recorder)
        self.view.open()

    def close(self) -> None:
        """Close them, and let them write what they have kept; this may take seconds."""
        if self.recorder is not None:
            self._observers.remove(self.recorder)
            self.recorder.close()
        self.view.close()
