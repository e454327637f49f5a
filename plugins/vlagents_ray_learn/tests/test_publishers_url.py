"""What a `Publisher` says of a URL that is wrong, or of a server that takes no weights."""

from __future__ import annotations

import re
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from certificates import authority
from plain_servers import WithoutPaths, http_server

from vlagents_ray.errors import ConfigError, UnknownApp
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.registry import pip_install
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_learn import Publisher

VALUES = {"w": np.zeros(1, np.float32)}


def test_the_url_of_a_port_that_speaks_tls_is_named(tmp_path: Path) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*authority(tmp_path, "ours").sign("server"))
    with (
        http_server(context) as port,
        pytest.raises(ConfigError, match=f"write https://127.0.0.1:{port}"),
    ):
        Publisher(f"http://127.0.0.1:{port}").push(VALUES)


def test_an_application_that_does_not_exist_is_named_by_its_path() -> None:
    with (
        http_server(handler=WithoutPaths) as port,
        pytest.raises(UnknownApp, match="no application at this path"),
    ):
        Publisher(f"http://127.0.0.1:{port}/raech").push(VALUES)


@pytest.mark.parametrize(
    "call",
    [
        lambda weights: weights.push(VALUES),
        lambda weights: weights.sleep(),
        lambda weights: weights.wake(),
        lambda weights: weights.acknowledged(1),
    ],
    ids=["push", "sleep", "wake", "acknowledged"],
)
def test_a_server_without_the_part_is_named_with_the_cure(call: Callable[[Publisher], Any]) -> None:
    engine = Engine(Noop())
    engine.start()
    metadata = {"parts": {"live": {"page": "/live"}}}
    inside = build_http_app(engine, lambda: metadata, MessageLimits())
    with served(AccessMiddleware(inside, None, "app")) as port:
        weights = Publisher(f"http://127.0.0.1:{port}")
        with pytest.raises(
            ConfigError, match=re.escape(pip_install(distribution="vlagents-ray-learn"))
        ):
            call(weights)
    engine.close()
