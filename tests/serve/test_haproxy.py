"""When HAProxy is ready: what its statistics must say of an application's replicas."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace
from typing import Any

import pytest

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.serve.haproxy import wait_for_haproxy

UP, DOWN = "http-app,SERVE_REPLICA::1,UP", "http-app,SERVE_REPLICA::1,DOWN"


@contextmanager
def statistics(*rows: str) -> Iterator[int]:
    """A page of HAProxy's statistics; yields its port."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write("\n".join(["# pxname,svname,status", *rows, ""]).encode())

        def log_message(self, *_: Any) -> None:
            """Nothing."""

    with HTTPServer(("127.0.0.1", 0), Page) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def serving(running: int) -> Any:
    """Serve, with one application of so many replicas."""
    policy = SimpleNamespace(replica_states={"RUNNING": running})
    application = SimpleNamespace(deployments={"Policy": policy})
    return SimpleNamespace(status=lambda: SimpleNamespace(applications={"app": application}))


@pytest.mark.parametrize(("running", "rows"), [(1, [UP]), (0, []), (0, [DOWN])])
def test_it_reaches_all_that_run(running: int, rows: list[str]) -> None:
    """An application may be down to no replica before HAProxy was asked: nobody waits for that."""
    with statistics(*rows) as port:
        wait_for_haproxy(serving(running), {"app": "/"}, port, time.monotonic() + 30)


@pytest.mark.parametrize(("running", "rows"), [(1, []), (1, [DOWN]), (2, [UP])])
def test_it_is_late_while_a_replica_that_runs_is_not_reached(running: int, rows: list[str]) -> None:
    with statistics(*rows) as port, pytest.raises(PolicyUnavailable, match="'app'"):
        wait_for_haproxy(serving(running), {"app": "/"}, port, time.monotonic())
