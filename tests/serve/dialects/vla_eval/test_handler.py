"""vla-eval's benchmarks: chunks row by row, and no observation that is out of date."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from dialect_server import receive, seen, send, serving
from served_agents import Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.interface import Act, Obs
from vlagents_ray.serve.engine.engine import Engine


def test_vla_eval_gets_one_row_a_step_and_a_new_chunk_after_the_last(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/vla-eval") as socket:
        assert context[0].get("/health").json() == {"status": "ok"}
        send(socket, "hello", {"protocol_version": 1}, 1)
        hello = receive(socket)
        assert (hello.kind, hello.seq, hello.payload["protocol_version"]) == ("hello", 1, 1)
        assert hello.payload["observation_params"] == {"send_state": True}
        send(socket, "episode_start", {"task": {}}, 2)
        got = []
        for seq in range(3, 7):
            send(socket, "observation", seen(seq), seq)
            answer = receive(socket)
            assert (answer.kind, answer.seq) == ("action", seq)
            got.append(answer.payload["actions"][[0, 2, 4]].tolist())
        # Two rows of a chunk each: the pixel and the count are those of the observation that was acted on.
        assert got == [[3, 1, 0], [3, 1, 1], [5, 2, 0], [5, 2, 1]]
        send(socket, "episode_start", {"task": {}}, 7)
        send(socket, "observation", seen(9), 8)
        assert receive(socket).payload["actions"][[0, 2, 4]].tolist() == [9, 1, 0]


def test_vla_evals_errors_leave_the_connection(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/vla-eval") as socket:
        for version in (2, None, np.zeros(2)):
            send(socket, "hello", {"protocol_version": version}, 1)
            assert receive(socket).kind == "error"
        socket.send_bytes(b"junk")
        assert receive(socket).kind == "error"
        send(socket, "observation", {"images": {"front": np.zeros(3)}}, 3)
        error = receive(socket)
        assert (error.kind, error.seq) == ("error", 3)
        assert "images/front" in error.payload["error"]
        send(socket, "observation", seen(4), 4)
        assert receive(socket).kind == "action"


def test_of_observations_that_nobody_waits_for_the_newest_is_acted_on() -> None:
    begun, gate = threading.Event(), threading.Event()

    class Slow(Mirror):
        def act(self, obs: Obs) -> Act:
            begun.set()
            gate.wait(10)
            return super().act(obs)

    with serving(Slow(), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        send(socket, "observation", seen(1), 1)
        assert begun.wait(10)
        for seq in range(2, 50):
            send(socket, "observation", seen(seq), seq)
        send(socket, "hello", {"protocol_version": 1}, 50)  # its answer says that all before it are there
        gate.set()
        assert [receive(socket).seq for _ in range(3)] == [1, 49, 50]


def test_a_client_that_sends_far_more_than_it_waits_for_is_cut_off(context: tuple[TestClient, Engine]) -> None:
    with serving(Mirror(slow_s=0.1), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        for seq in range(100):
            send(socket, "observation", seen(1), seq)
            send(socket, "hello", {"protocol_version": 1}, seq)
        received = [receive(socket)]
        while received[-1].kind != "error":
            received.append(receive(socket))
        assert "wait" in received[-1].payload["error"]
        assert len(received) < 100
        with pytest.raises(WebSocketDisconnect) as closed:
            receive(socket)
        assert closed.value.code == 1008
