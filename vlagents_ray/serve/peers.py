"""The other replicas of the same Serve application, called as actors."""

from __future__ import annotations

import logging
from typing import Any

import ray
from ray import serve

from vlagents_ray.client.handle import call_replica

logger = logging.getLogger(__name__)

_NAMESPACE = "serve"
_ANSWER_S = 3.0  # a replica that still loads answers nobody


class Peers:
    """Looks the replicas up anew for each call: they come and go."""

    def __init__(self) -> None:
        context = serve.get_replica_context()
        self._prefix = f"SERVE_REPLICA::{context.app_name}#{context.deployment}#"
        self._me = context.replica_id.to_full_id_str()

    def take(self, session_id: str) -> dict[str, Any] | None:
        """Ask all of them at once: at most one has it."""
        waiting = [call_replica(actor, "export_session", session_id) for actor in self._actors()]
        state: dict[str, Any] | None = None
        while waiting and state is None:
            ready, waiting = ray.wait(waiting, num_returns=1, timeout=_ANSWER_S)
            if not ready:
                break
            state = _result(ready[0])
        return state

    def give(self, session_id: str, state: dict[str, Any]) -> bool:
        """To the first that takes it."""
        return any(_result(call_replica(actor, "import_session", session_id, state)) for actor in self._actors())

    def _actors(self) -> list[Any]:
        found = []
        for entry in ray.util.list_named_actors(all_namespaces=True):
            name = entry["name"]
            if entry["namespace"] == _NAMESPACE and name.startswith(self._prefix) and name != self._me:
                try:
                    found.append(ray.get_actor(name, namespace=_NAMESPACE))
                except ValueError:  # it ended meanwhile
                    continue
        return found


def _result(reference: Any) -> Any:
    try:
        return ray.get(reference, timeout=_ANSWER_S)
    except (ray.exceptions.RayError, TimeoutError) as error:
        logger.info("another replica does not answer: %s", error)
        return None
