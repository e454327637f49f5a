"""Timings in replies, and the load of a queue, over endpoints without Ray."""

from __future__ import annotations

import gc
import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_flight import send, submit
from starlette.testclient import TestClient
from websockets.sync.client import connect

from vlagents_ray.images.codecs import JPEG
from vlagents_ray.interface import SLACK, Act, Agent, Obs
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_requests
from vlagents_ray.protocol.messages import MessageLimits, Op, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import SAMPLE, MetricsBuffer
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.queue.batch_queue import LoadMeter, QueueLoad

OBS = Obs({"front": np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)}, 0.5)


class Large(Agent):
    """A policy with large answers. It waits for the gate if the observation requests it."""

    gate = threading.Event()

    def act(self, obs: Obs) -> Act:
        if obs.info.get("wait"):
            self.gate.wait(60)
        if obs.info.get("fail"):
            raise RuntimeError("no")
        return Act(np.zeros((50, 7)), info={"list": list(range(5000)), "text": "ünïcode"})


@pytest.fixture
def engine() -> Iterator[Engine]:
    engine = Engine(Large())
    yield engine
    engine.close()


@pytest.fixture
def client(engine: Engine) -> Iterator[TestClient]:
    engine.start()
    engine.stats.enable()
    with TestClient(
        AccessMiddleware(build_http_app(engine, dict, MessageLimits()), None, "app")
    ) as client:
        yield client


def check(timing: dict[str, float], round_trip_ms: float) -> None:
    stages = [timing[f"{stage}_ms"] for stage in ("decode", "queue", "inference", "encode")]
    assert min(stages) > 0, timing
    assert sum(stages) <= timing["total_ms"] <= round_trip_ms, timing


def test_stages_add_up_over_http_in_json_and_in_frames(client: TestClient) -> None:
    headers = {"x-session-id": "robot", "content-type": CONTENT_TYPE}
    client.post("/v1/reset", content=encode_requests([Request("reset", OBS)]), headers=headers)
    begun = time.perf_counter()
    answer = client.post(
        "/v1/act", content=encode_requests([Request("act", OBS)], JPEG), headers=headers
    )
    check(answer.json()["timing"], (time.perf_counter() - begun) * 1e3)
    assert answer.json()["info"]["text"] == "ünïcode"
    begun = time.perf_counter()
    answer = client.post(
        "/v1/act",
        content=encode_requests([Request("act", OBS)], JPEG),
        headers={**headers, "accept": CONTENT_TYPE},
    )
    check(decode_replies(answer.content)[0].timing, (time.perf_counter() - begun) * 1e3)
    form = {"obs": (None, json.dumps({"gripper": 1.0}), "application/json")}
    begun = time.perf_counter()
    answer = client.post("/v1/act", files=form, headers={"x-session-id": "robot"})
    check(answer.json()["timing"], (time.perf_counter() - begun) * 1e3)


def test_what_was_answered_is_recorded_with_its_code(client: TestClient, engine: Engine) -> None:
    headers = {"x-session-id": "robot", "content-type": CONTENT_TYPE}
    for op, obs in (("act", OBS), ("reset", OBS), ("act", OBS), ("act", Obs(info={"fail": 1}))):
        client.post(f"/v1/{op}", content=encode_requests([Request(op, obs)]), headers=headers)  # type: ignore[arg-type]
    client.post("/v1/act", content=b"VLA", headers=headers)
    with served(client.app) as port, connect(f"ws://127.0.0.1:{port}/v1/stream") as socket:
        socket.send(b"garbage")
        socket.recv(10)
        socket.send(encode_requests([Request("reset", OBS)]))
        socket.recv(10)
        assert engine.sessions.by_transport() == {"http": 1, "websocket": 1}
    batches: list[int] = []
    requests: Counter[Any] = Counter()

    def are_all_recorded() -> bool:  # some values are recorded just after the answer
        collected = engine.stats.collect()
        batches.extend(collected.batches.values)
        requests.update({kind: sample.count for kind, sample in collected.requests.items()})
        return len(batches) >= 2 and requests.total() >= 7

    wait_for(are_all_recorded)
    assert batches == [1, 1]
    assert requests == {
        ("act", "http", "robot", "unknown_session"): 1,
        ("reset", "http", "robot", "ok"): 1,
        ("act", "http", "robot", "ok"): 1,
        ("act", "http", "robot", "policy_failed"): 1,
        ("act", "http", "robot", "malformed"): 1,
        ("unknown", "websocket", "robot", "malformed"): 1,
        ("reset", "websocket", "robot", "ok"): 1,
    }


KIND = ("act", "shm", "robot", "ok")


def test_nothing_is_kept_for_nobody_and_each_thing_once() -> None:
    stats = MetricsBuffer()
    stats.handled(KIND, (1.0,))
    stats.batch(3, 4)
    stats.enable()
    nothing = stats.collect()
    assert (nothing.requests, nothing.batches.count, nothing.padding) == ({}, 0, 0)
    stats.handled(KIND, (2.0,))
    stats.batch(3, 4)
    found = stats.collect()
    assert (found.requests[KIND].values, found.batches.values, found.padding) == ([(2.0,)], [3], 1)
    assert stats.collect().requests == {}


def test_all_are_counted_from_whatever_thread_and_a_fair_sample_is_kept() -> None:
    stats = MetricsBuffer()
    stats.enable()
    threads = [
        threading.Thread(target=lambda: [stats.handled(KIND, (float(n),)) for n in range(10_000)])
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    sample = stats.collect().requests[KIND]
    assert (sample.count, len(sample.values)) == (40_000, SAMPLE)
    mean = sum(value for (value,) in sample.values) / SAMPLE
    # Five standard errors of a uniform distribution.
    assert abs(mean - 5_000) < 5 * 10_000 / 12**0.5 / SAMPLE**0.5


@pytest.mark.own_process
def test_a_request_leaves_nothing_to_the_garbage_collector(engine: Engine) -> None:
    """Otherwise garbage collections would pause the policy regularly."""
    engine.start()
    sender, answered = (
        Sender(engine, "shm", caller=NoKey.OPEN, has_left=None),
        threading.Semaphore(0),
    )

    def ask(op: Op) -> None:
        send(sender, [Request(op, Obs())], lambda _: answered.release())
        assert answered.acquire(timeout=10)

    ask("reset")
    ask("act")
    gc.collect()
    gc.disable()
    try:
        for _ in range(50):
            ask("act")
        assert gc.collect() < 50
    finally:
        gc.enable()


def test_the_load_is_the_busy_share_and_the_part_of_it_for_robots_with_slack(
    engine: Engine,
) -> None:
    engine.start()
    meter = LoadMeter(engine.queue)
    answered = threading.Semaphore(0)

    def begin(name: str, request: Request) -> None:
        submit(engine, name, request, lambda _: answered.release() and None)

    for name in ("a", "b"):
        begin(name, Request("reset", Obs()))
    assert all(answered.acquire(timeout=10) for _ in range(2))
    meter.read()
    time.sleep(0.2)
    assert meter.read().utilisation < 0.2

    for name, info in (("a", {}), ("b", {SLACK: 500.0})):
        Large.gate.clear()
        begin(name, Request("act", Obs(info={"wait": True, **info})))
        wait_for(lambda: engine.queue.depth() == 0)  # the request is in a batch
        meter.read()
        time.sleep(0.2)
        Large.gate.set()
        assert answered.acquire(timeout=60)
        wait_for(lambda: not engine.queue._running)
        load = meter.read()
        assert load.utilisation > 0.9
        assert (load.paced > 0.9) == bool(info)


def test_robots_with_slack_need_less_than_they_use() -> None:
    assert QueueLoad(0.9, paced=0.8).needed(robots_need=0.3) == pytest.approx(0.4)
    assert QueueLoad(0.5, paced=0.1).needed(robots_need=0.3) == 0.5
    assert QueueLoad(1.0, paced=1.0).needed(robots_need=1.0) == 1.0
