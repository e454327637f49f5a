"""Mistakes on the command line of `vlagents-ray bench` are told before anything starts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from vlagents_ray.cli.main import app


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["rtt", "--transports", "smoke"], "smoke"),
        (["throughput", "--clients", "few"], "few"),
        (["policy", "noop", "--batch", "0"], "from 1"),
        (["policy", "noop", "--state", "joints=some"], "joints"),
        (["policy", "noop", "--set", "colour=blue"], "colour"),
        (["policy", "nowhere.yaml"], "nowhere.yaml"),
        (["throughput", "--set", "base_ms=1"], "--policy"),
    ],
)
def test_mistakes_are_told_in_a_line(words: list[str], text: str) -> None:
    done = CliRunner().invoke(app, ["bench", *words])
    assert done.exit_code == 2, done.output
    assert text in done.stderr
    assert "Traceback" not in done.output


def test_a_policy_is_measured_with_other_settings_than_its_files(tmp_path: Path) -> None:
    words = ["noop", "--set", "base_ms=20", "--batch", "1", "--seconds", "0.1", "--rounds", "1"]
    done = CliRunner().invoke(app, ["bench", "policy", *words, "--json", str(tmp_path / "found.json")])
    assert done.exit_code == 0, done.output
    [row] = json.loads((tmp_path / "found.json").read_text())["batches"]
    assert row["bare"]["batch_ms"] >= 20
    assert row["queued_share"] == pytest.approx(row["queued"]["actions_per_s"] / row["bare"]["actions_per_s"])
