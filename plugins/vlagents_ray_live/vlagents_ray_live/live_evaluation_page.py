"""The live page of an evaluation, which the process of the command serves: `eval --live` and
`report --live`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager

from vlagents_ray.evaluate.report.results_document import ResultsDocument
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.replica.part import SiblingPart
from vlagents_ray_live.live_page import page_server
from vlagents_ray_live.live_view import Fleet
from vlagents_ray_live.sibling_views import METHODS, SiblingViews

_PART = "live"  # the name of the live part of the policies' replicas
_NAME = "eval"  # the application of the page, for keys that are limited to applications


@contextmanager
def serve_evaluation(
    document: ResultsDocument,
    apps: Collection[str],
    address: tuple[str, int],
    keys: Keys | None,
) -> Iterator[str]:
    """Serve a page with the progress, the results, and the sessions of the policies' replicas, on a
    thread.

    Args:
        document: The progress and the results.
        apps: The applications in this process's cluster whose sessions the page shows.
        address: The host and port to listen on; port 0 selects a free port.
        keys: The accepted keys; None admits all clients, and is allowed only on a loopback address.

    Yields:
        The URL of the page.

    Raises:
        ConfigError: Other machines could reach the page without a key, or the address is in use.
    """
    views = _views(apps) if apps else None
    fleet = Fleet(None, views, document.read)
    with page_server(fleet, address, keys, name=_NAME, videos=document.video) as url:
        yield url


def _views(apps: Collection[str]) -> SiblingViews:
    """Return the views of all replicas of applications in this process's cluster."""
    from vlagents_ray.serve.scaling.sibling_replicas import ReplicasInCluster

    replicas = ReplicasInCluster(apps)

    async def live_parts() -> list[SiblingPart]:
        """Return the live part of each replica."""
        return [SiblingPart(replica, _PART, METHODS) for replica in await replicas.others()]

    return SiblingViews(live_parts)
