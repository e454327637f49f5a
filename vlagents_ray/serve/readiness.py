"""When a server is ready: its applications run, and their doors answer."""

from __future__ import annotations

import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Collection, Mapping
from typing import Any

from vlagents_ray.errors import ConfigError, PolicyUnavailable


def wait_until_ready(serve: Any, apps: Mapping[str, str], ours: Collection[str], deadline: float) -> None:
    """Until each application, which are given with their URLs, runs and its door answers.

    `ours` are those that say why they cannot act yet. Raises `ConfigError` for what keeps one from ever doing so, and
    `PolicyUnavailable` at the `deadline`, of `time.monotonic()`.
    """
    while True:
        status = serve.status().applications
        for name in apps:
            app = status.get(name)
            if app is not None and app.status in ("DEPLOY_FAILED", "UNHEALTHY"):
                raise ConfigError(f"application {name!r} failed to deploy: {_reason(app)}")
        if all(name in status and status[name].status == "RUNNING" for name in apps):
            break
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"not running in time: { {n: str(status[n].status) for n in apps if n in status} }")
        time.sleep(0.1)
    for name, url in apps.items():
        while (refusal := _refusal(url)) is not None:
            refusal = (_said_inside(serve, name) if name in ours else None) or refusal
            if "did not load" in refusal:
                raise ConfigError(f"application {name!r}: {refusal}")
            if time.monotonic() > deadline:
                raise PolicyUnavailable(f"application {name!r} is not ready: {refusal}")
            time.sleep(0.05)


def _refusal(url: str) -> str | None:
    """Why `/healthz` is not 200 yet; None when it is."""
    unverified = ssl._create_unverified_context() if url.startswith("https") else None  # noqa: S323 - our own door
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5, context=unverified):  # noqa: S310 - our own URL
            return None
    except urllib.error.HTTPError as error:
        error.close()
        return f"HTTP {error.code}"
    except OSError as error:
        return str(error)


def _said_inside(serve: Any, app: str) -> str | None:
    """Why the policy cannot act yet, which the door tells only whoever has a key."""
    from ray.exceptions import RayError
    from ray.serve.exceptions import RayServeException

    try:
        refusal: str | None = serve.get_app_handle(app).refusal.remote().result(timeout_s=5)
    except (RayError, RayServeException, TimeoutError):
        return None
    return refusal


def _reason(app: Any) -> str:
    """The last line of what Serve says of a failure: the error, below its traceback."""
    texts = [app.message, *(d.message for d in app.deployments.values())]
    lines = [line.strip() for text in texts for line in (text or "").splitlines() if line.strip()]
    return lines[-1] if lines else "Serve gives no reason"
