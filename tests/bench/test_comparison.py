"""Two runs of a benchmark side by side."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.bench.figures import compare_figures, measured_on, read_figures
from vlagents_ray.errors import ConfigError


def run(median_ms: float, *, clients: int = 2, cpu: str = "A", ray: str = "2.60") -> dict[str, Any]:
    return {
        "machine": {"cpu": cpu, "cores": 2, "load": median_ms},
        "versions": {"ray": ray},
        "ways": [
            {"way": "shm", "calls": 100, "median_ms": median_ms, "ci95_ms": [median_ms - 1, median_ms + 1]},
            {"way": "http", "calls": 100, "median_ms": 5.0, "ci95_ms": [4.0, 6.0]},
        ],
        "curve": [{"clients": clients, "actions_per_s": 100 / median_ms, "rounds": [1.0, 2.0]}],
    }


def test_each_figure_stands_beside_the_one_of_the_same_place() -> None:
    found = compare_figures(run(10.0), run(20.0))
    assert [(one.name, one.old, one.new, one.ratio, one.overlap) for one in found.figures] == [
        ("ways / shm / median_ms", 10.0, 20.0, 2.0, False),
        ("ways / http / median_ms", 5.0, 5.0, 1.0, True),
        ("curve / clients 2 / actions_per_s", 10.0, 5.0, 0.5, None),
    ]
    assert found.only_old == found.only_new == found.circumstances == ()


def test_what_differs_besides_figures_is_said() -> None:
    found = compare_figures(run(10.0), run(10.0, clients=4, cpu="B", ray="2.61"))
    assert found.only_old == ("curve / clients 2 / actions_per_s",)
    assert found.only_new == ("curve / clients 4 / actions_per_s",)
    assert found.circumstances == ("cpu: A before, B now", "ray: 2.60 before, 2.61 now")


def test_the_measured_page_can_be_compared_with_itself() -> None:
    figures = read_figures(Path(__file__).parents[2] / "benchmarks" / "latest.json")
    found = compare_figures(figures, figures)
    assert len(found.figures) > 50
    assert {one.ratio for one in found.figures} == {1.0}
    assert found.only_new == found.circumstances == ()


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"machine": {"cores": 2}}'])
def test_another_file_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "figures.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match="want what `bench … --json FILE` wrote"):
        read_figures(file)


def test_what_figures_depend_on_is_json_without_names_of_hosts() -> None:
    said = json.loads(json.dumps(measured_on()))
    assert said.keys() == {"date", "command", "machine", "versions"}
    assert said["versions"].keys() >= {"vlagents-ray", "numpy", "Python"}
    assert said["machine"].keys() == {"cpu", "cores", "memory_gb", "kernel", "load"}
