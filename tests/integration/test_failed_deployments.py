"""Starting a server whose policy or gateway cannot be served fails with an error that states the
reason.
"""

from __future__ import annotations

import socket

import pytest

from tests.integration.conftest import serving
from vlagents_ray import ConfigError
from vlagents_ray.serve.ports import free_port

pytestmark = pytest.mark.usefixtures("shared_ray")


@pytest.mark.parametrize("gateway", [False, True])
def test_a_policy_that_does_not_load_says_why(gateway: bool) -> None:
    dialects = {"vlagents": {"port": free_port()}} if gateway else {}
    with (
        pytest.raises(ConfigError, match="no checkpoint here"),
        serving("served_agents:Broken", dialects=dialects),
    ):
        pytest.fail("the server started although the policy did not load")


def test_a_gateways_taken_port_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(ConfigError, match=f"vlagents: cannot listen on 127.0.0.1:{port}"),
            serving("noop", dialects={"vlagents": {"port": port}}),
        ):
            pytest.fail("the server started without its gateway")
