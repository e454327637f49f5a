"""vla-eval's benchmarks: chunks row by row, and no observation that is out of date."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from dialect_house import hear, say, seen, serving
from served_agents import Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.interface import Act, Obs
from vlagents_ray.serve.engine import Engine


def test_vla_eval_gets_one_row_a_step_and_a_new_chunk_after_the_last(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/vla-eval") as socket:
        assert house[0].get("/health").json() == {"status": "ok"}
        say(socket, "hello", {"protocol_version": 1}, 1)
        hello = hear(socket)
        assert (hello.kind, hello.seq, hello.payload["protocol_version"]) == ("hello", 1, 1)
        assert hello.payload["observation_params"] == {"send_state": True}
        say(socket, "episode_start", {"task": {}}, 2)
        got = []
        for seq in range(3, 7):
            say(socket, "observation", seen(seq), seq)
            answer = hear(socket)
            assert (answer.kind, answer.seq) == ("action", seq)
            got.append(answer.payload["actions"][[0, 2, 4]].tolist())
        # Two rows of a chunk each: the pixel and the count are those of the observation that was acted on.
        assert got == [[3, 1, 0], [3, 1, 1], [5, 2, 0], [5, 2, 1]]
        say(socket, "episode_start", {"task": {}}, 7)
        say(socket, "observation", seen(9), 8)
        assert hear(socket).payload["actions"][[0, 2, 4]].tolist() == [9, 1, 0]


def test_vla_evals_errors_leave_the_connection(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/vla-eval") as socket:
        for version in (2, None, np.zeros(2)):
            say(socket, "hello", {"protocol_version": version}, 1)
            assert hear(socket).kind == "error"
        socket.send_bytes(b"junk")
        assert hear(socket).kind == "error"
        say(socket, "observation", {"images": {"front": np.zeros(3)}}, 3)
        error = hear(socket)
        assert (error.kind, error.seq) == ("error", 3)
        assert "images/front" in error.payload["error"]
        say(socket, "observation", seen(4), 4)
        assert hear(socket).kind == "action"


def test_of_observations_that_nobody_waits_for_the_newest_is_acted_on() -> None:
    begun, gate = threading.Event(), threading.Event()

    class Slow(Mirror):
        def act(self, obs: Obs) -> Act:
            begun.set()
            gate.wait(10)
            return super().act(obs)

    with serving(Slow(), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        say(socket, "observation", seen(1), 1)
        assert begun.wait(10)
        for seq in range(2, 50):
            say(socket, "observation", seen(seq), seq)
        say(socket, "hello", {"protocol_version": 1}, 50)  # its answer says that all before it are there
        gate.set()
        assert [hear(socket).seq for _ in range(3)] == [1, 49, 50]


def test_a_client_that_sends_far_more_than_it_waits_for_is_cut_off(house: tuple[TestClient, Engine]) -> None:
    with serving(Mirror(slow_s=0.1), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        for seq in range(100):
            say(socket, "observation", seen(1), seq)
            say(socket, "hello", {"protocol_version": 1}, seq)
        heard = [hear(socket)]
        while heard[-1].kind != "error":
            heard.append(hear(socket))
        assert "wait" in heard[-1].payload["error"]
        assert len(heard) < 100
        with pytest.raises(WebSocketDisconnect) as closed:
            hear(socket)
        assert closed.value.code == 1008
