"""Mistakes on the command line of `python -m benchmarks.NAME` are reported before anything
starts.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from benchmarks import (
    evaluation,
    policy,
    robots,
    rtt,
    success,
    throughput,
)
from benchmarks.checkpoints import __main__ as checkpoints
from vlagents_ray.cli.main import app as product

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def programs() -> Iterator[tuple[str, typer.Typer]]:
    """Yield the name and the application of each benchmark with a command line, and of the
    product.
    """
    yield "vlagents_ray.cli.main", product
    for file in sorted(BENCHMARKS.rglob("*.py")):
        text = file.read_text()
        if "typer.run(main)" not in text and "typer.Typer(" not in text:
            continue
        name = ".".join(file.relative_to(BENCHMARKS.parent).with_suffix("").parts)
        module = importlib.import_module(name)
        app = getattr(module, "app", None)
        if app is None:
            app = typer.Typer()
            app.command()(module.main)
        yield name, app


def repeated_options(command: Any, path: str) -> list[str]:
    """Return the options that a command, or a command below it, has twice."""
    counts = Counter[str]()
    for parameter in command.params:
        counts.update((*parameter.opts, *parameter.secondary_opts))
    repeated = [f"{path} {option}" for option, count in counts.items() if count > 1]
    for name, below in getattr(command, "commands", {}).items():
        repeated += repeated_options(below, f"{path} {name}")
    return repeated


def test_no_command_has_an_option_twice() -> None:
    """The second of two options with one name would take the values of both."""
    names = []
    repeated = []
    for name, app in programs():
        names.append(name)
        repeated += repeated_options(get_command(app), name)
    assert len(names) > 10
    assert repeated == []


# Where a mistake is not noticed, the benchmark starts, and would run for as long as a test may.
@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    ("module", "words", "text"),
    [
        (checkpoints, ["smolvl", "made"], "smolvla"),
        (checkpoints, ["act", "made", "--dtype", "bfloat16"], "float32"),
        (checkpoints, ["act", "made", "--size", "huge"], "small"),
        (evaluation, ["--episodes", "5"], "multiple of the 2 workers"),
        (evaluation, ["--peers", "nobody"], "nobody"),
        (policy, ["noop", "--batch", "0"], "from 1"),
        (policy, ["noop", "--state-dim", "joints=some"], "joints"),
        (policy, ["noop", "--state-dim", "joints=1000000000000000000"], "from 1 to 1000000"),
        (policy, ["noop", "--set", "colour=blue"], "colour"),
        (policy, ["nowhere.yaml"], "nowhere.yaml"),
        (robots, ["--chunks", "9"], "mixed"),
        (robots, ["--loads", "full"], "full"),
        (robots, ["--systems", "nobody"], "nobody"),
        (robots, ["--times", "500:8"], "one robot with --chunks 8"),
        (robots, ["--times", "29.3"], "BASE:ROW"),
        (rtt, ["--peers", "nobody"], "nobody"),
        (rtt, ["--transports", "smoke"], "smoke"),
        (success, ["--only", "again;faster"], "faster"),
        (throughput, ["--clients", "few"], "few"),
        (throughput, ["--set", "base_ms=1"], "--policy"),
        (throughput, ["--peers", "openpi", "--policy", "scripted"], "noop"),
    ],
)
def test_mistakes_are_reported_in_a_line(module: ModuleType, words: list[str], text: str) -> None:
    app = typer.Typer()
    app.command()(module.main)
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output
