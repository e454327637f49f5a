"""The recording of a replica's sessions, as its deployment says."""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require
from vlagents_ray.serve.config.deployment import RecordArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.recording.episodes import EpisodeWriter
from vlagents_ray.serve.recording.recorder import SessionRecorder

_GB = 1e9


def open_recorder(
    engine: Engine, args: RecordArgs | None, replica: str, metadata: Callable[[], Mapping[str, Any]]
) -> SessionRecorder | None:
    """Record the sessions of an engine from now on.

    Args:
        engine: The engine of the replica.
        args: The settings; None records nothing.
        replica: Ray's name of the replica, which no other has or will have.
        metadata: Returns the metadata of the replica.

    Raises:
        ConfigError: The folder cannot be written to.
        MissingDependency: The extra "record" is not installed.
    """
    if args is None:
        return None
    for name in ("av", "pyarrow"):
        require(name)
    folder = Path(args.folder)
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ConfigError(f"record.folder: {folder} cannot be written to ({error})") from error

    def find(session: str) -> tuple[str, int]:
        found = engine.sessions.get(session)
        return found.instruction, found.first

    name = re.sub(r"[^A-Za-z0-9]+", "-", replica.removeprefix("SERVE_REPLICA::"))
    writer = EpisodeWriter(
        folder,
        f"{time.strftime('%Y%m%d-%H%M%S', time.gmtime())}-{name}",
        args.fps,
        lossless=args.pictures == "exact",
        most_bytes=args.most_gb * _GB,
        describe=metadata,
    )
    recorder = SessionRecorder(writer, engine.sessions.ids, find, share=args.share)
    engine.observers.add(recorder)
    return recorder
