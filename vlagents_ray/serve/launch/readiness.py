"""The check that a server is ready: its applications run, and their HTTP ports respond."""

from __future__ import annotations

import logging
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Collection, Mapping
from typing import Any

from vlagents_ray.errors import ConfigError, PolicyUnavailable

log = logging.getLogger(__name__)

_REMIND_S = 30.0


def wait_until_ready(
    serve: Any,
    apps: Mapping[str, str | None],
    ours: Collection[str],
    deadline: float,
    missing: Callable[[], str | None] = lambda: None,
) -> None:
    """Wait until each application runs and responds.

    Args:
        serve: The module `ray.serve`.
        apps: The URL of each application; one without a URL is called through a Serve handle.
        ours: The applications of this package, which report why their policy is not ready yet.
        deadline: End of the waiting, s, of `time.monotonic()`.
        missing: Describes the resources that the cluster lacks; logged at once, and again every 30 s.

    Raises:
        ConfigError: An application failed to deploy, or a policy to load.
        PolicyUnavailable: The deadline has passed.
    """
    remind_at = 0.0
    while True:
        status = serve.status().applications
        for name in apps:
            app = status.get(name)
            if app is not None and app.status in ("DEPLOY_FAILED", "UNHEALTHY"):
                raise ConfigError(f"application {name!r} failed to deploy: {_reason(app)}")
        if all(name in status and status[name].status == "RUNNING" for name in apps):
            break
        if time.monotonic() > deadline:
            states = {n: str(status[n].status) for n in apps if n in status}
            raise PolicyUnavailable("; ".join(filter(None, [f"not running in time: {states}", missing()])))
        if time.monotonic() >= remind_at:
            remind_at = time.monotonic() + _REMIND_S
            if (what := missing()) is not None:
                log.warning("waiting: %s", what)
        time.sleep(0.1)
    for name, url in apps.items():
        while (refusal := _unready_reason(serve, name, url, ours)) is not None:
            if "did not load" in refusal:
                raise ConfigError(f"application {name!r}: {refusal}")
            if time.monotonic() > deadline:
                raise PolicyUnavailable(f"application {name!r} is not ready: {refusal}")
            time.sleep(0.05)


def _unready_reason(serve: Any, app: str, url: str | None, ours: Collection[str]) -> str | None:
    """Return the reason why the application is not ready; None if it is.

    The reason comes from a replica, since over HTTP it is reported only to clients with a key.
    """
    refusal = None if url is None else _http_reason(url)
    if app not in ours or (url is not None and refusal is None):
        return refusal
    return _replica_reason(serve, app) or refusal


def _http_reason(url: str) -> str | None:
    """Return the reason why `/healthz` does not reply with 200; None if it does."""
    unverified = ssl._create_unverified_context() if url.startswith("https") else None  # noqa: S323 - our own server
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5, context=unverified):  # noqa: S310 - our own URL
            return None
    except urllib.error.HTTPError as error:
        error.close()
        return f"HTTP {error.code}"
    except OSError as error:
        return str(error)


def _replica_reason(serve: Any, app: str) -> str | None:
    """Return the reason why the policy cannot act yet, as its replica reports it; None if it can act."""
    from ray.exceptions import RayError
    from ray.serve.exceptions import RayServeException

    try:
        refusal: str | None = serve.get_app_handle(app).refusal.remote().result(timeout_s=5)
    except (RayError, RayServeException, TimeoutError) as error:
        return str(error) or type(error).__name__
    return refusal


def _reason(app: Any) -> str:
    """Return the last line of Serve's message about a failure, which is the error below its traceback."""
    texts = [app.message, *(d.message for d in app.deployments.values())]
    lines = [line.strip() for text in texts for line in (text or "").splitlines() if line.strip()]
    return lines[-1] if lines else "Serve gives no reason"
