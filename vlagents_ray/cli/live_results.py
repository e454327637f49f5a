"""The live page of `--live`: the results of an evaluation, or of a training, as they are added."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import ray
import typer

from vlagents_ray.cli.console import out
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Progress
from vlagents_ray.evaluate.report.results_document import ProgressDocument, ResultsDocument
from vlagents_ray.serve.access.api_keys import load_keys
from vlagents_ray.serve.observers.live_page import page_server, require_watch_keys
from vlagents_ray.serve.observers.live_view import Fleet
from vlagents_ray.serve.ports import LOOPBACK, is_free
from vlagents_ray.serve.scaling.sibling_replicas import ReplicasInCluster

_PORT = 8050  # of the page, if it is free
_NAME = "eval"  # the page's application, for keys that are limited to applications


def live_address(at: str | None) -> tuple[str, int]:
    """Return the (host, port) that `--live-at` states; None is `--live` alone."""
    if at is None:
        return LOOPBACK, _PORT if is_free(LOOPBACK, _PORT) else 0
    try:
        parts = urlsplit(f"//{at}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.netloc != at:
        raise ConfigError(f"--live-at: got {at!r}, want HOST:PORT, as in 127.0.0.1:{_PORT}")
    require_watch_keys(host, load_keys())  # before anything is served
    return host, port


@contextlib.contextmanager
def live_progress(
    config: EvalConfig, progress: Progress, address: tuple[str, int], *, goes_on: bool = False
) -> Iterator[Progress]:
    """Show an evaluation by `progress` and on the live page, within the context of its Ray.

    Yields:
        The progress to evaluate with.
    """
    document = ProgressDocument(config.out, progress, goes_on=goes_on)
    urls = [str(one.url) for one in config.policies]
    apps = [url.removeprefix("serve://") for url in urls if url.startswith("serve://")]
    others = ReplicasInCluster(apps) if apps and ray.is_initialized() else None
    with _page(document, others, address):
        try:
            yield document
        except Exception as error:
            if not isinstance(error, typer.Exit):
                document.fail(str(error))
            raise
        finally:
            document.close()


def follow(results: Path, address: tuple[str, int]) -> None:
    """Serve the page of an evaluation or a training that another process writes to a folder, until Ctrl-C."""
    with _page(ResultsDocument(results), None, address), contextlib.suppress(KeyboardInterrupt):
        threading.Event().wait()


@contextlib.contextmanager
def _page(document: ResultsDocument, others: ReplicasInCluster | None, address: tuple[str, int]) -> Iterator[None]:
    fleet = Fleet(None, others, document.read)
    with page_server(fleet, address, load_keys(), name=_NAME, videos=document.video) as url:
        out.print(f"live: {url}")
        yield
