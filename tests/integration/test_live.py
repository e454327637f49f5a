"""The live page of a server with two replicas, through Ray Serve's port."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, closing

import numpy as np
import pytest
from live_server import ask

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import open_websocket
from vlagents_ray.serve.launch.server import Server

TRANSPORTS = ("shm", "plasma", "websocket", "http", "handle")


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with serving("noop", replicas=2) as server:
        yield server


def test_a_viewer_sees_the_sessions_of_both_replicas_and_all_transports(server: Server) -> None:
    obs = Obs({"front": np.zeros((8, 8, 3), np.uint8)}, 1.0)
    with ExitStack() as stack:
        agents = []
        for transport in TRANSPORTS * 2:
            url = "serve://noop" if transport in ("handle", "plasma") else server.url
            agents.append(stack.enter_context(RemoteAgent(url, transport=transport)))
            agents[-1].reset(obs, "watch this")
        url = server.url.replace("http", "ws") + "/v1/live"
        viewer = stack.enter_context(closing(open_websocket(url, Credentials(""), 10)))
        shown: set[str] = set()
        acted, pictured, replicas = set(), set(), set()
        while len(shown) < len(agents) or acted != shown or pictured != shown or len(replicas) < 2:
            for agent in agents:
                agent.act(obs)
            document, files = ask(viewer, sorted(shown))
            for replica in document["replicas"]:
                replicas.add(replica["name"])
                shown |= {session["id"] for session in replica["sessions"]}
                acted |= {
                    one["id"]
                    for one in replica["sessions"]
                    if one.get("last", {}).get("op") == "act"
                }
                pictured |= {one["id"] for one in replica["sessions"] if one["pictures"]}
                assert {one["instruction"] for one in replica["sessions"]} <= {"watch this"}
        assert all(file.startswith(b"\xff\xd8") for file in files)


def test_a_command_of_the_page_reaches_the_session_whichever_replica_it_is_at(
    server: Server,
) -> None:
    with urllib.request.urlopen(f"{server.url}/live", timeout=10) as answer:
        assert b"/v1/live" in answer.read()
    with ExitStack() as stack:
        inboxes, agents = [CommandInbox() for _ in range(4)], []
        for inbox in inboxes:
            agents.append(
                stack.enter_context(RemoteAgent(server.url, transport="websocket", commands=inbox))
            )
            agents[-1].reset(Obs(), "wait")
        with urllib.request.urlopen(f"{server.url}/v1/live", timeout=10) as answer:
            replicas = json.load(answer)["replicas"]
        assert len(replicas) == 2
        sessions = {one["id"] for replica in replicas for one in replica["sessions"]}
        for session in sessions:
            body = json.dumps({"session": session, "do": "stop"}).encode()
            headers = {"content-type": "application/json"}
            request = urllib.request.Request(f"{server.url}/v1/live/command", body, headers)
            with urllib.request.urlopen(request, timeout=10) as answer:
                assert json.load(answer)["state"] == "waiting"
        for agent in agents:
            agent.act(Obs())
        assert [[one.do for one in inbox.waiting] for inbox in inboxes] == [["stop"]] * 4
