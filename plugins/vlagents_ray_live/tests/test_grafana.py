"""Tests that the Grafana dashboard in cluster/grafana queries all series of a server, and no
others.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import ray

from vlagents_ray.errors import BY_CODE
from vlagents_ray.interface import Agent
from vlagents_ray.serve.config.parts import PartConfig
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.replica import metrics
from vlagents_ray.serve.replica.part import PartContext
from vlagents_ray_learn import weights_part
from vlagents_ray_live import recording

ROOT = Path(__file__).parents[3]
DASHBOARD = json.loads((ROOT / "cluster/grafana/policy_server.json").read_text())
MONITORING = (ROOT / "docs/monitoring.md").read_text()
TAGS = ("application", "deployment", "replica", "policy")
SUFFIXES = {"Counter": ("_total",), "Gauge": ("",), "Histogram": ("_bucket", "_sum", "_count")}


class Series(NamedTuple):
    """A series of a metric, as Prometheus reads it."""

    metric: str
    labels: set[str]


@pytest.fixture(scope="module")
def exported() -> dict[str, Series]:
    """Return the series that a replica and its parts declare, by the name that Prometheus reads."""
    series = {}

    def declared(kind: str) -> Any:
        class Declared:
            def __init__(self, name: str, *, tag_keys: tuple[str, ...], **_: Any) -> None:
                for suffix in SUFFIXES[kind]:
                    own = {"le"} if suffix == "_bucket" else set()
                    series[f"ray_{name}{suffix}"] = Series(name, {*tag_keys, *own})

            def set_default_tags(self, tags: dict[str, str]) -> Any:
                return self

        return Declared

    with pytest.MonkeyPatch.context() as patch:
        for kind in SUFFIXES:
            patch.setattr(metrics, kind, declared(kind))
            for part in (recording, weights_part):  # each part uses some of the kinds
                patch.setattr(part, kind, declared(kind), raising=False)
        engine = Engine(Agent())
        tags = dict.fromkeys(TAGS, "x")
        metrics.Exporter(engine, tags)
        recording.RecordingMetrics(SimpleNamespace(), tags)  # type: ignore[arg-type]
        context = PartContext(engine, "replica", "node", dict, metric_tags=tags)
        weights_part.WeightsPart(PartConfig(), context)
        engine.close()
    return series


def queries() -> list[tuple[str, str]]:
    """Return the expression and legend of every line of the dashboard, and the query of its
    variable.
    """
    lines = [
        (target["expr"], target["legendFormat"])
        for panel in DASHBOARD["panels"]
        for target in panel["targets"]
    ]
    variables = [
        (one["query"]["query"], "")
        for one in DASHBOARD["templating"]["list"]
        if one["type"] == "query"
    ]
    return lines + variables


def names(expression: str) -> set[str]:
    """Return the series that an expression names."""
    return set(re.findall(r"\bray_\w+", expression))


@pytest.mark.parametrize(("expression", "legend"), queries())
def test_a_query_names_series_and_labels_that_the_server_exports(
    expression: str, legend: str, exported: dict[str, Series]
) -> None:
    assert names(expression)
    grouped = {
        label.strip()
        for group in re.findall(r"\bby \(([^)]*)\)", expression)
        for label in group.split(",")
    }
    shown = set(re.findall(r"\{\{(\w+)\}\}", legend))
    if "sum by" in expression:
        assert shown <= grouped
    asked = grouped | shown | set(re.findall(r'(\w+)!?=~?"', expression))
    asked |= set(re.findall(r"label_values\(\w+, (\w+)\)", expression))
    for name in names(expression) - {"ray_node_gpus_utilization"}:
        assert name in exported
        assert asked <= exported[name].labels | ({"le"} if name.endswith("_bucket") else set())


def test_an_alert_in_the_documentation_names_series_and_labels_that_the_server_exports(
    exported: dict[str, Series],
) -> None:
    alerts = re.findall(r"\| `(\w+\([^`]*ray_vlagents[^`]*)` \|", MONITORING)
    assert len(alerts) > 3
    for expression in alerts:
        assert names(expression) <= exported.keys()


def test_no_increase_is_computed_of_a_counter_that_begins_with_its_first_event() -> None:
    """A series that begins with the first event has no earlier value, so this event is no increase.
    A replica whose policy hung is replaced, so no second event follows.
    """
    expressions = [expression for expression, _ in queries()]
    expressions += re.findall(r"`(\w+\([^`]*ray_vlagents[^`]*)`", MONITORING)
    rare = {"ray_vlagents_hung_calls_total", "ray_vlagents_out_of_memory_total"}
    using_rare = [expression for expression in expressions if names(expression) & rare]
    assert len(using_rare) == 4
    assert not any(re.search(r"\b(increase|rate)\(", expression) for expression in using_rare)


def test_every_metric_of_the_server_is_on_the_dashboard_and_in_the_documentation(
    exported: dict[str, Series],
) -> None:
    shown = {name for expression, _ in queries() for name in names(expression)}
    assert {series.metric for series in exported.values()} == {
        exported[name].metric for name in shown if name in exported
    }
    documented = set(re.findall(r"`(vlagents_(?!ray)\w+)`", MONITORING))
    assert documented == {
        re.sub("^ray_", "", name) if name.endswith("_total") else series.metric
        for name, series in exported.items()
    }


def test_no_series_has_a_label_for_each_session(exported: dict[str, Series]) -> None:
    """The values of each label, except those that identify the replica, are constants of the
    code.
    """
    words = {"op", "transport", "priority", "model", "code", "stage", "kind", "outcome", "le"}
    labels = set().union(*(series.labels for series in exported.values()))
    assert labels - set(TAGS) <= words


def test_the_metric_of_gpus_is_one_of_ray() -> None:
    dashboard = Path(ray.__file__).parent / "dashboard"
    assert (
        '"node_gpus_utilization": Gauge('
        in (dashboard / "modules/reporter/reporter_agent.py").read_text()
    )
    assert re.search(r'GPU_TAG_KEYS = .*"GpuIndex"', (dashboard / "consts.py").read_text())


def test_the_codes_that_queries_ask_for_are_those_of_errors() -> None:
    asked = [
        text
        for expression, _ in queries()
        for text in re.findall(r'code!?=~?"([^"]+)"', expression)
    ]
    codes = {code for text in asked for code in text.split("|")}
    assert codes
    assert codes <= {"ok", *BY_CODE}


def test_every_panel_reads_the_chosen_data_source_has_a_place_of_its_own_and_says_what_it_shows() -> (
    None
):
    variables = {one["name"]: one for one in DASHBOARD["templating"]["list"]}
    assert variables["datasource"]["type"] == "datasource"
    assert variables["datasource"]["query"] == "prometheus"
    taken: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}
        assert panel["title"]
        assert panel["description"]
        at = panel["gridPos"]
        cells = {(at["x"] + i, at["y"] + j) for i in range(at["w"]) for j in range(at["h"])}
        assert at["x"] + at["w"] <= 24
        assert not taken & cells
        taken |= cells
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
