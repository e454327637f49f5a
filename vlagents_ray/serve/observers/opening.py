"""Opens the observers of a replica by their keys in its settings: `live` and `record`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

from vlagents_ray import tracing
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer
from vlagents_ray.serve.observers.live_view import ReplicaView
from vlagents_ray.serve.observers.recording import SessionRecorder, open_recorder
from vlagents_ray.serve.observers.spans import RequestSpans


class ReplicaObservers(NamedTuple):
    """The open observers of one replica."""

    view: ReplicaView  # the data for viewers; the live observer is active only while it is read
    recorder: SessionRecorder | None
    close: Callable[[], None]  # closes them in reverse order; they write the data that they have kept, for seconds


def open_observers(
    engine: Engine, args: ServerArgs, replica: str, node: str, metadata: Callable[[], Mapping[str, Any]]
) -> ReplicaObservers:
    """Create the observers in the settings of a replica, which observe the engine's requests from now on.

    Args:
        replica: Ray's name of the replica, which is unique over time.
        node: The name of its node, for viewers.

    Raises:
        ConfigError: A folder is not writable.
        MissingDependency: An extra is not installed.
    """
    observers, name = engine.observers, replica.rpartition("#")[2]
    with ExitStack() as opened:

        def observe(observer: Observer) -> None:
            opened.callback(observer.close)
            opened.callback(observers.remove, observer)
            observers.add(observer)

        view = ReplicaView(engine, name, node, metadata, args.live)
        view.open()
        opened.callback(view.close)
        if (tracer := tracing.tracer()) is not None:
            observe(RequestSpans(tracer, name))
        recorder = None
        if args.record is not None:
            observe(recorder := open_recorder(engine.sessions, args.record, replica, metadata))
        return ReplicaObservers(view, recorder, opened.pop_all().close)
