"""The series that a replica exports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.replica import metrics
from vlagents_ray.serve.replica.metrics import Exporter


def test_the_series_of_a_gpu_have_values_only_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    written: dict[str, list[Any]] = {}

    def series(_tags: object, _kind: object, name: str, *_: object, **__: object) -> Any:
        def write(*value: Any) -> None:
            written.setdefault(name, []).append(value)

        return SimpleNamespace(set=write, inc=write, observe=write)

    monkeypatch.setattr(metrics, "series", series)
    engine = Engine(Noop.from_config({}), EngineSettings(threaded=False))
    engine.start()
    exporter = Exporter(engine, {})
    engine.stats.enable()
    monkeypatch.setattr(CudaGraph, "replays", 0)
    exporter.export()
    of_gpu = {"gpu_memory_bytes", "gpu_ms", "graph_replays"}
    assert written.keys() & of_gpu == set()
    assert written["utilisation"]
    monkeypatch.setattr(engine.models, "gpu_memory", lambda: {"free": 7, "reserved": 5})
    engine.stats.gpu(3.5)
    CudaGraph.replays += 2
    exporter.export()
    exporter.export()
    assert {name: written[name] for name in of_gpu} == {
        "gpu_memory_bytes": [(7, {"kind": "free"}), (5, {"kind": "reserved"})] * 2,
        "gpu_ms": [(3.5,)],
        "graph_replays": [(2,)],
    }
    engine.close()
