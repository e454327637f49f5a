"""The other replicas of the same Serve application, called as actors."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from typing import Any

import ray
from ray import serve

from vlagents_ray.client.handle import call_replica
from vlagents_ray.serve.spread import Load

logger = logging.getLogger(__name__)

_NAMESPACE = "serve"
_ANSWER_S = 3.0  # a replica that still loads answers nobody
_QUICK_S = 0.3  # a client that connects waits for it
_SILENT_S = 3.0  # a replica that did not answer is not asked for its load again


class Peers:
    """Looks the replicas up anew for each call: they come and go."""

    def __init__(self) -> None:
        context = serve.get_replica_context()
        self._prefix = f"SERVE_REPLICA::{context.app_name}#{context.deployment}#"
        self.me = context.replica_id.to_full_id_str()
        self._silent: dict[str, float] = {}  # until when

    def take(self, session_id: str) -> dict[str, Any] | None:
        """Ask all of them at once: at most one has it."""
        waiting = [call_replica(actor, "export_session", session_id) for _, actor in self._actors()]
        state: dict[str, Any] | None = None
        while waiting and state is None:
            ready, waiting = ray.wait(waiting, num_returns=1, timeout=_ANSWER_S)
            if not ready:
                break
            state = _result(ready[0])
        return state

    def give(self, session_id: str, state: dict[str, Any]) -> bool:
        """To the first that takes it."""
        return any(_result(call_replica(actor, "import_session", session_id, state)) for _, actor in self._actors())

    def loads(self) -> list[Load]:
        """What each of those holds that answer at once; takes a third of a second, at most."""
        now = time.monotonic()
        self._silent = {name: until for name, until in self._silent.items() if until > now}
        asked = {call_replica(actor, "load"): name for name, actor in self._actors() if name not in self._silent}
        if not asked:
            return []
        ready, late = ray.wait(list(asked), num_returns=len(asked), timeout=_QUICK_S)
        for reference in late:
            self._silent[asked[reference]] = now + _SILENT_S
        return [load for reference in ready if (load := _result(reference)) is not None]

    def invite(self, replica: str) -> Any:
        """Tell another replica that a client is sent there; `answer` waits for what it says to the client."""
        try:
            return call_replica(ray.get_actor(replica, namespace=_NAMESPACE), "welcome")
        except ValueError:  # it ended meanwhile
            return None

    @staticmethod
    def answer(invitation: Any) -> Any:
        """None if the other replica does not answer at once."""
        return _result(invitation, _QUICK_S)

    def _actors(self) -> Iterator[tuple[str, Any]]:
        for entry in ray.util.list_named_actors(all_namespaces=True):
            name = entry["name"]
            if entry["namespace"] == _NAMESPACE and name.startswith(self._prefix) and name != self.me:
                try:
                    yield name, ray.get_actor(name, namespace=_NAMESPACE)
                except ValueError:  # it ended meanwhile
                    continue


def _result(reference: Any, timeout_s: float = _ANSWER_S) -> Any:
    try:
        return ray.get(reference, timeout=timeout_s)
    except (ray.exceptions.RayError, TimeoutError) as error:
        logger.info("another replica does not answer: %s", error)
        return None
