"""Sessions are distributed again when some have ended, or when a replica has joined, on every route
from a client to a replica.
"""

from __future__ import annotations

import http.client
import json
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import pytest
from eval_fakes import wait_for
from shared_ray import shared_server

from tests.integration.conftest import ROUTES, deploy, states
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

APP = "Located"
SESSIONS = 12
EVERY_S = 0.25
SPREAD_S = 40.0  # comparisons are 3 s apart, and sessions move only after two agreeing comparisons


def deployed(replicas: int) -> Deployment:
    """Return the policy with that many replicas, like `serve deploy` sees it after a change."""
    document = deployment(f"served_agents:{APP}").model_dump(exclude_unset=True)
    document["applications"][0]["deployments"] = [{"name": "Policy", "num_replicas": replicas}]
    return Deployment(applications=document["applications"])


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(deployed(2)) as server:
        yield server


def scale(replicas: int) -> None:
    deploy(deployed(replicas))
    wait_for(lambda: states(APP) == {"RUNNING": replicas})


class Client:
    """A session of this package's client, which checks that no act is lost or repeated."""

    def __init__(self, server: Server, transport: TransportName) -> None:
        url = f"serve://{APP}" if transport == "handle" else server.url
        self.agent = RemoteAgent(url, transport=transport)
        self.acts = 0
        self.replica = self.agent.reset(Obs())["pid"]

    def act(self) -> None:
        act = self.agent.act(Obs())
        self.acts += 1
        assert act.action.tolist() == [self.acts]
        assert "resumed" not in act.info
        self.replica = act.info["pid"]


class JsonClient:
    """A session of a client that supports only HTTP and JSON."""

    def __init__(self, server: Server, name: str, *, follows_links: bool) -> None:
        """Begin a session.

        Args:
            server: The server.
            name: The session's name.
            follows_links: Whether it uses a replica's own port, which an answer names.
        """
        self._name, self._follows_links = name, follows_links
        self._server_port = urlsplit(server.url).netloc
        self._own_port: tuple[str, str] | None = None  # address and path
        self.acts = 0
        self.replica = self._ask("reset")["info"]["pid"]

    def act(self) -> None:
        answer = self._ask("act")
        self.acts += 1
        assert answer["action"] == [self.acts]
        self.replica = answer["info"]["pid"]

    def close(self) -> None:
        self._own_port = None
        self._ask("close")

    def _ask(self, op: str) -> dict[str, Any]:
        address, path = self._own_port or (self._server_port, "/v1")
        connection = http.client.HTTPConnection(address, timeout=30)
        headers = {"content-type": "application/json", "x-session-id": self._name}
        connection.request("POST", f"{path}/{op}", b"{}", headers)
        answer = connection.getresponse()
        document: dict[str, Any] = json.loads(answer.read() or b"{}")
        connection.close()
        assert answer.status == 200, document

        link = re.match(r"<//([^/]+)(/.*)/\w+>", answer.headers.get("link", ""))
        if link is not None and self._follows_links:
            self._own_port = link[1], link[2]
        elif answer.headers.get("connection") == "close":
            self._own_port = None
        return document


def held(clients: Sequence[Client | JsonClient]) -> Counter[int]:
    """Act once in each session, and return the number of sessions by replica."""
    for client in clients:
        client.act()
    return Counter(client.replica for client in clients)


@pytest.mark.parametrize("route", [route for route in ROUTES if route != "shm"])
def test_a_replica_with_too_many_sessions_gives_some_away(
    server: Server, reach: Callable[[str], TransportName], route: str
) -> None:
    """In an earlier version, HTTP sessions stayed at their replica."""
    transport = reach(route)
    with ExitStack() as stack:
        clients = [Client(server, transport) for _ in range(SESSIONS)]
        for client in clients:
            stack.callback(client.agent.close)

        (fuller, count), *_ = held(clients).most_common()
        left = [client for client in clients if client.replica == fuller]
        for client in clients:
            if client.replica != fuller:
                client.agent.close()

        def is_even() -> bool:
            counts = held(left)
            return len(counts) == 2 and max(counts.values()) <= min(counts.values()) + 2

        begun = time.monotonic()
        wait_for(is_even, SPREAD_S, EVERY_S)
        print(f"{route}: {count} sessions are even after {time.monotonic() - begun:.1f} s")


def test_sessions_whose_answers_are_json_spread_when_a_replica_joins(server: Server) -> None:
    """The proxy's hash gives the new replica its share of the sessions, including those that use
    own ports.
    """
    scale(1)
    clients = {
        follows_links: [
            JsonClient(server, f"{follows_links}-{number}", follows_links=follows_links)
            for number in range(SESSIONS)
        ]
        for follows_links in (False, True)
    }
    for group in clients.values():
        assert len(held(group)) == 1

    scale(2)
    for follows_links, group in clients.items():

        def are_spread(group: Sequence[JsonClient] = group) -> bool:
            counts = held(group)
            return len(counts) == 2 and min(counts.values()) >= 2

        begun = time.monotonic()
        wait_for(are_spread, SPREAD_S, EVERY_S)
        print(f"own ports {follows_links}: spread after {time.monotonic() - begun:.1f} s")
    for group in clients.values():
        for client in group:
            client.close()
