"""Tests of the plan of a fleet with the durations of batches that a running server has measured."""

from __future__ import annotations

import contextlib
import random
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from asgi_server import served

from vlagents_ray import Agent, ChunkPlayer, Obs, PlayerSettings, RemoteAgent
from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.noop import Noop, NoopConfig
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.robot.pacing import Pacer
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray_fleet import fleet_file
from vlagents_ray_fleet.check import check
from vlagents_ray_fleet.fleet_file import Costs, FleetFile
from vlagents_ray_fleet.plan import FleetPlan, plan

ROBOTS, HZ, ROWS = 12, 10.0, 20
BASE_MS, ROW_MS = 30.0, 8.0
GPUS = {"count": 1, "memory_gb": 80}


@contextlib.contextmanager
def serving(agent: Agent, **metadata: Any) -> Iterator[str]:
    """Yield the address of a server whose metadata contain the costs that it measures, or those in
    `metadata`.
    """
    engine = Engine(agent)
    engine.start()

    def describe() -> dict[str, Any]:
        contract = engine.contract
        return {
            "policy": "noop",
            "version": "0",
            "protocol": PROTOCOL_VERSION,
            "local": None,
            "contract": None if contract is None else contract.to_json(),
            "batch_costs": engine.queue.window.describe_costs(),
            **metadata,
        }

    app = AccessMiddleware(build_http_app(engine, describe, DEFAULT_LIMITS), None, "app")
    try:
        with served(app) as port:
            yield f"http://127.0.0.1:{port}"
    finally:
        engine.close()


def drive(url: str, seconds: float, warm_s: float) -> float:
    """Run robots at their rate, and return the share of their ticks in time after `warm_s`."""
    begin = threading.Barrier(ROBOTS)

    def run(_: int) -> tuple[int, int]:
        agent = RemoteAgent(url, transport="websocket", timeout_s=20)
        with ChunkPlayer(agent, PlayerSettings(mode="async", safe="zero")) as player:
            player.initialize()
            begin.wait(60)
            time.sleep(random.uniform(0, 1))
            player.reset(Obs(), slo={"hz": HZ})
            pacer = Pacer(HZ)
            warm = (0, 0)
            for tick in range(round((warm_s + seconds) * HZ)):
                pacer.wait()
                player.act(Obs())
                if tick == round(warm_s * HZ):
                    warm = player.timeliness.ticks, player.timeliness.starved
            return player.timeliness.ticks - warm[0], player.timeliness.starved - warm[1]

    with ThreadPoolExecutor(ROBOTS) as threads:
        counts = list(threads.map(run, range(ROBOTS)))
    return 1 - sum(starved for _, starved in counts) / sum(ticks for ticks, _ in counts)


def planned(costs: dict[str, Any]) -> FleetPlan:
    """Return the plan of the robots with a model of these costs."""
    return plan(
        FleetFile(
            robots={"arms": {"count": ROBOTS, "hz": HZ, "models": {"pi0": {"rows": ROWS}}}},
            models={"pi0": {"costs": costs, "memory_gb": 9}},
            gpus=GPUS,
        )
    )


@pytest.mark.slow
def test_the_costs_that_a_server_measures_make_the_plan_that_its_robots_show() -> None:
    config = NoopConfig(chunk=ROWS, delta=True, base_ms=BASE_MS, per_item_ms=ROW_MS)
    with serving(Noop(config)) as url:
        measured_share = drive(url, seconds=8.0, warm_s=3.0)
        measured = Costs(url=url).curve()
        solved = planned({"url": url})

    sizes = [size for size, _ in measured.table]
    assert len(sizes) >= 2
    assert sizes[-1] == 16, "the server's largest batch is in the curve"
    for size in sizes:
        true_s = (BASE_MS + ROW_MS * size) / 1e3
        assert 0.95 * true_s <= measured.cost_s(size) <= 1.25 * true_s + 0.01, size

    from_file = planned({"fixed_ms": BASE_MS, "row_ms": ROW_MS})
    [model], [model_from_file] = solved.models, from_file.models
    assert (solved.gpus_used, model.replicas) == (from_file.gpus_used, model_from_file.replicas)
    assert model.load == pytest.approx(model_from_file.load, rel=0.25, abs=0.05)

    [group] = model.groups
    [simulated] = check(solved, seconds=40.0).groups
    assert abs(group.share - measured_share) <= 0.03
    assert abs(simulated.share - measured_share) <= 0.03


@pytest.mark.parametrize(
    ("batch_costs", "message"),
    [
        (
            None,
            "expected batches of at least two sizes at http://.*, got those of none; let robots",
        ),
        ({"fixed_ms": None, "row_ms": None, "ms_by_size": {"4": 70}}, r"got those of \['4'\]"),
        ({"ms_by_size": {"1": 40, "4": -1}}, "expected milliseconds by batch size from http://"),
        ({"ms_by_size": {"1": 40, "few": 70}}, "expected milliseconds by batch size from http://"),
        ({"ms_by_size": "no"}, "got those of none"),
        ("no", "got those of none"),
    ],
)
def test_a_server_without_measured_batches_is_an_error_with_the_cure(
    batch_costs: object, message: str
) -> None:
    with (
        serving(Noop(), batch_costs=batch_costs) as url,
        pytest.raises(ConfigError, match=rf"costs\.url: .*{message}"),
    ):
        Costs(url=url).curve()


def test_an_address_without_a_server_is_an_error_with_the_cure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet_file, "_SERVER_S", 0.2)
    with pytest.raises(
        ConfigError, match=r"costs\.url: expected the metadata .* running\? Or write"
    ):
        Costs(url="http://127.0.0.1:1/").curve()
