"""The metrics that a replica exports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from in_flight import opened

from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.in_time import RobotReport
from vlagents_ray.serve.models.loaded_model import GpuWork
from vlagents_ray.serve.replica import metrics
from vlagents_ray.serve.replica.metrics import Exporter
from vlagents_ray.serve.requests import Origin

SERIES = 22  # number of metrics with values in a replica without a GPU, for any number of robots


def test_the_series_of_a_gpu_have_values_only_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    written: dict[str, list[Any]] = {}

    def series(_tags: object, _kind: object, name: str, *_: object, **__: object) -> Any:
        def write(*value: Any) -> None:
            written.setdefault(name, []).append(value)

        return SimpleNamespace(set=write, inc=write, observe=write)

    monkeypatch.setattr(metrics, "series", series)
    monkeypatch.setattr(CudaGraph, "replays", 7)  # of earlier engines of this process
    engine = Engine(Noop.from_config({}), EngineSettings(threaded=False))
    engine.start()
    exporter = Exporter(engine, {})
    engine.stats.enable()
    exporter.export()
    of_gpu = {"gpu_memory_bytes", "gpu_ms", "graph_replays"}
    assert written.keys() & of_gpu == set()
    assert written["utilisation"]
    monkeypatch.setattr(engine.model, "gpu_memory", lambda: {"free": 7, "reserved": 5})
    engine.stats.gpu(3.5)
    CudaGraph.replays += 2
    exporter.export()
    exporter.export()
    assert {name: written[name] for name in of_gpu} == {
        "gpu_memory_bytes": [(7, {"kind": "free"}), (5, {"kind": "reserved"})] * 2,
        "gpu_ms": [(3.5,)],
        "graph_replays": [(2,)],
    }

    work = GpuWork(passes_ms=[1.5], last_ms=1.5, out_of_memory=3, replays=4)
    monkeypatch.setattr(engine.model, "gpu_work_elsewhere", lambda: work)
    exporter.export()
    assert written["gpu_ms"][1:] == [(1.5,)]
    assert written["graph_replays"][1:] == [(4,)]
    assert written["out_of_memory"] == [(3,)]
    engine.close()


def test_the_ticks_of_a_robot_that_is_always_in_time_are_exported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written: dict[str, float] = {}

    def series(_tags: object, _kind: object, name: str, *_: object, **__: object) -> Any:
        def increment(value: float = 1.0, _tags: object = None) -> None:
            if value <= 0:
                raise ValueError(f"value must be >0, got {value}")  # like Ray's counters
            written[name] = value

        def observe(value: float, _tags: object = None) -> None:
            written[name] = value

        return SimpleNamespace(set=observe, inc=increment, observe=observe)

    monkeypatch.setattr(metrics, "series", series)
    engine = Engine(Noop.from_config({}), EngineSettings(threaded=False))
    engine.start()
    exporter = Exporter(engine, {})
    engine.stats.enable()
    engine.stats.report("robot", RobotReport(10, 0, 30.0))
    exporter.export()
    assert (written["ticks"], written["executed_age_ms"]) == (10, 30.0)
    assert "starved_ticks" not in written
    assert not {"compared_ages", "ages_beyond_tolerance"} & written.keys()

    engine.stats.report("robot", RobotReport(10, 0, 30.0, is_tolerated=True))
    exporter.export()
    assert written["compared_ages"] == 1
    assert "ages_beyond_tolerance" not in written
    for is_tolerated in (False, True, False):
        engine.stats.report("robot", RobotReport(10, 0, 30.0, is_tolerated))
    exporter.export()
    assert (written["compared_ages"], written["ages_beyond_tolerance"]) == (3, 2)

    engine.stats.report("robot", RobotReport(0, 0, None))
    exporter.export()
    engine.close()


def test_the_sessions_of_all_transports_are_exported(monkeypatch: pytest.MonkeyPatch) -> None:
    exported: dict[str, float] = {}

    def series(_tags: object, _kind: object, name: str, *_: object, **__: object) -> Any:
        def write(value: float = 1.0, tags: dict[str, str] | None = None) -> None:
            if name == "sessions" and tags is not None:
                exported[tags["transport"]] = value

        return SimpleNamespace(set=write, inc=write, observe=write)

    monkeypatch.setattr(metrics, "series", series)
    engine = Engine(Noop.from_config({}), EngineSettings(threaded=False))
    engine.start()
    exporter = Exporter(engine, {})
    for number, transport in enumerate(["sglang", "sglang", "xpolicylab", "shm", "of somebody"]):
        opened(engine.sessions, str(number), Origin(transport))
        exporter.export()
        assert sum(exported.values()) == len(engine.sessions) == number + 1
    assert exported["sglang"] == 2
    for number in range(5):
        engine.sessions.close(str(number))
        exporter.export()
        assert sum(exported.values()) == len(engine.sessions)
    engine.close()


@pytest.mark.parametrize("robots", [10, 10_000])
def test_the_number_of_series_does_not_grow_with_the_robots(
    monkeypatch: pytest.MonkeyPatch, robots: int
) -> None:
    series_of_values: set[tuple[str, tuple[tuple[str, str], ...]]] = set()

    def series(_tags: object, _kind: object, name: str, *_: object, **__: object) -> Any:
        def write(_value: float = 1.0, tags: dict[str, str] | None = None) -> None:
            series_of_values.add((name, tuple(sorted((tags or {}).items()))))

        return SimpleNamespace(set=write, inc=write, observe=write)

    monkeypatch.setattr(metrics, "series", series)
    monkeypatch.setattr(metrics, "_PAUSE_S", 0.0)
    # Other tests of this process may have replayed graphs.
    monkeypatch.setattr(CudaGraph, "replays", 0)
    engine = Engine(Noop.from_config({}), EngineSettings(threaded=False))
    engine.start()
    exporter = Exporter(engine, {})
    engine.stats.enable()

    report = RobotReport(10, 1, 30.0, is_tolerated=False)
    for _ in range(robots):
        engine.stats.report("robot", report)
        engine.stats.handled(("act", "websocket", "robot", "ok"), (5.0, 1.0, 1.0, 2.0, 1.0))
    exporter.export()

    in_time = {"ticks", "starved_ticks", "executed_age_ms"}
    in_time |= {"compared_ages", "ages_beyond_tolerance"}
    labels = {name: [] for name in in_time}
    for name, tags in sorted(series_of_values):
        if name in in_time:
            labels[name].append(tags)
    robot = (("priority", "robot"),)
    assert labels == {
        "ticks": [robot],
        "starved_ticks": [robot],
        "executed_age_ms": [robot],
        "compared_ages": [robot],
        "ages_beyond_tolerance": [robot],
    }
    assert len(series_of_values) == SERIES
    engine.close()
