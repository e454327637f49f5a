"""Mistakes on the command line of `python -m benchmarks.NAME` are reported before anything
starts.
"""

from __future__ import annotations

from types import ModuleType

import pytest
import typer
from typer.testing import CliRunner

from benchmarks import (
    autoscaling,
    evaluation,
    far_away,
    fleet,
    growth,
    hop,
    learners,
    policy,
    report,
    rollouts,
    rtt,
    scaling,
    success,
    throughput,
    torchrl,
)
from benchmarks.checkpoints import __main__ as checkpoints


# Where a mistake is not noticed, the benchmark starts, and would run for as long as a test may.
@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    ("module", "words", "text"),
    [
        (autoscaling, ["--plot", "a.gif"], ".png"),
        (checkpoints, ["smolvl", "made"], "smolvla"),
        (checkpoints, ["act", "made", "--dtype", "bfloat16"], "float32"),
        (checkpoints, ["act", "made", "--size", "huge"], "small"),
        (evaluation, ["--episodes", "5"], "multiple of the 2 workers"),
        (evaluation, ["--peers", "nobody"], "nobody"),
        (far_away, ["--modes", "async,nobody"], "nobody"),
        (fleet, ["--curve", "steep"], "steep"),
        (fleet, ["--delay", "2ms"], "add --link"),
        (fleet, ["--kinds", "10"], "HZ:ROWS"),
        (fleet, ["--link", "1gbit", "--transport", "shm"], "does not cross a network"),
        (fleet, ["--systems", "nobody"], "nobody"),
        (fleet, ["--transport", "smoke"], "smoke"),
        (growth, ["--sessions", "few"], "few"),
        (growth, ["--transport", "handle"], "handle"),
        (hop, ["--python", "nowhere"], "nowhere"),
        (learners, ["--learners", "nobody"], "nobody"),
        (learners, ["--seeds", "first"], "first"),
        (report, ["--page", "nowhere/tables.md"], "nowhere"),
        (policy, ["noop", "--batch", "0"], "from 1"),
        (policy, ["noop", "--state-dim", "joints=some"], "joints"),
        (policy, ["noop", "--set", "colour=blue"], "colour"),
        (policy, ["nowhere.yaml"], "nowhere.yaml"),
        (rollouts, ["--envs", "15"], "multiples of the 2 workers"),
        (rtt, ["--peers", "nobody"], "nobody"),
        (rtt, ["--transports", "smoke"], "smoke"),
        (scaling, ["--workers", "2,4"], "from 1 on"),
        (scaling, ["--nodes", "none"], "--nodes"),
        (success, ["--only", "again;faster"], "faster"),
        (throughput, ["--clients", "few"], "few"),
        (throughput, ["--set", "base_ms=1"], "--policy"),
        (throughput, ["--peers", "openpi", "--policy", "scripted"], "noop"),
        (torchrl, ["--source", "nowhere"], "expected a checkout of TorchRL"),
    ],
)
def test_mistakes_are_reported_in_a_line(module: ModuleType, words: list[str], text: str) -> None:
    app = typer.Typer()
    app.command()(module.main)
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output
