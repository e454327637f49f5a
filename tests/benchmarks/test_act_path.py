"""The files that an act enters: in a period of one process, and over several acts."""

from __future__ import annotations

import sys
import time

import typer
from typer.testing import CliRunner

from benchmarks import act_path
from benchmarks.act_path import PathCounter, usual_files
from vlagents_ray.contract import Contract
from vlagents_ray.naming import without_duplicate_keys


def test_the_files_of_a_period_are_those_of_this_project_in_order() -> None:
    counter = PathCounter()

    def trace() -> tuple[float, float]:
        begun_s = time.perf_counter()
        sys.setprofile(counter.count)
        without_duplicate_keys([("a", 1)])
        Contract().to_json()
        without_duplicate_keys([("a", 1)])
        sys.setprofile(None)
        return begun_s, time.perf_counter()

    trace()
    begun_s, ended_s = trace()
    files = counter.files(begun_s, ended_s)
    assert files[:2] == ["vlagents_ray/naming.py", "vlagents_ray/contract.py"]
    assert len(files) == len(set(files))
    assert counter.files(ended_s, time.perf_counter()) == []


def test_a_file_that_few_acts_enter_is_left_out() -> None:
    assert usual_files([["a", "b"], ["a", "timer", "b"], ["b", "a"]]) == ["b", "a"]


def test_an_unknown_transport_is_reported_before_a_server_starts() -> None:
    app = typer.Typer()
    app.command()(act_path.main)
    done = CliRunner().invoke(app, ["--transports", "smoke"])
    assert done.exit_code == 2
    assert "smoke" in done.stderr
