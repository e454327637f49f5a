"""A machine that is in a cluster can be used alone, too."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.hosts import hosts, ray_cluster
from vlagents_ray.evaluate import Results

pytestmark = pytest.mark.ray

EVALUATE = [sys.executable, "-c", "from vlagents_ray.cli import main; main()", "eval", "tabletop", "--policy=scripted"]


@pytest.mark.hosts
def test_without_an_address_an_evaluation_has_a_ray_of_its_own(tmp_path: Path) -> None:
    show = [sys.executable, "-c", "import ray; ray.init(logging_level='ERROR'); print(ray.nodes()[0]['NodeID'])"]
    with hosts(1) as [host], ray_cluster([host]):
        host.run([*EVALUATE, "--episodes=1", f"--out={tmp_path / 'out'}"])
        node = host.run(show).split()[-1]
    found = Results.load(tmp_path / "out")
    assert [one.result.status for one in found.cells[0].episodes] == ["done"]
    assert found.workers[0].node != node
