"""Mistakes on the command line of `vlagents-ray bench` are told before anything starts."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from vlagents_ray.cli.main import app


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["rtt", "--peers", "nobody"], "nobody"),
        (["rtt", "--transports", "smoke"], "smoke"),
        (["rtt", "--plot", "a.gif"], ".png"),
        (["hop", "--python", "nowhere"], "nowhere"),
        (["throughput", "--clients", "few"], "few"),
        (["policy", "noop", "--batch", "0"], "from 1"),
        (["policy", "noop", "--state", "joints=some"], "joints"),
        (["policy", "nowhere.yaml"], "nowhere.yaml"),
        (["throughput", "--config", "{"], "JSON"),
        (["throughput", "--config", '{"base_ms": 1}'], "--policy"),
        (["throughput", "--model", "huge"], "size"),
        (["evaluation", "--episodes", "5"], "multiple of the 2 workers"),
        (["evaluation", "--peers", "nobody"], "nobody"),
        (["report", "--readme", "nowhere.md"], "nowhere.md"),
        (["scaling", "--workers", "2,4"], "from 1 on"),
        (["scaling", "--nodes", "none"], "--nodes"),
        (["autoscaling", "--plot", "a.gif"], ".png"),
    ],
)
def test_mistakes_are_told_in_a_line(words: list[str], text: str) -> None:
    done = CliRunner().invoke(app, ["bench", *words])
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output
