"""The picture of the round trips."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.test_report import RESULTS
from vlagents_ray.bench.figures import check_plot_file, plot_round_trips
from vlagents_ray.errors import ConfigError


@pytest.mark.parametrize(("name", "begins"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml")])
def test_it_is_drawn(tmp_path: Path, name: str, begins: bytes) -> None:
    plot_round_trips(RESULTS["rtt"], tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(begins)


def test_another_suffix_is_refused_before_anything_is_measured() -> None:
    check_plot_file(None)
    with pytest.raises(ConfigError, match=r"a\.gif.*\.png"):
        check_plot_file(Path("a.gif"))
