"""The files whose code an act runs: in a period of one process, and over several acts."""

from __future__ import annotations

import sys
import time

import typer
from typer.testing import CliRunner

from benchmarks import act_path
from benchmarks.act_path import PathCounter, page_table, usual
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
    files = counter.path(begun_s, ended_s)["files"]
    assert files[:2] == ["vlagents_ray/naming.py", "vlagents_ray/contract.py"]
    assert len(files) == len(set(files))
    assert counter.path(ended_s, time.perf_counter()) == {"files": [], "classes": []}


def test_the_classes_of_a_period_are_those_whose_methods_are_called() -> None:
    counter = PathCounter()
    contract = Contract()
    begun_s = time.perf_counter()
    sys.setprofile(counter.count)
    contract.to_json()
    without_duplicate_keys([])
    sys.setprofile(None)
    assert counter.path(begun_s, time.perf_counter())["classes"] == ["Contract"]


def test_the_table_has_the_numbers_of_both_sides() -> None:
    client = {"files": ["a", "b"], "classes": ["A"], "Python": 10.4, "C": 20.0, "system": 2.0}
    server = {"files": ["c"], "classes": ["B", "C"], "Python": 30.0, "C": 40.0}
    head, [row] = page_table([{"way": "shm", "client": client, "server": server}])
    assert row == ["shm", "2", "1", "10", "20", "2", "1", "2", "30", "40", ""]
    assert len(head) == len(row)


def test_a_file_that_few_acts_enter_is_left_out() -> None:
    assert usual([["a", "b"], ["a", "timer", "b"], ["b", "a"]]) == ["b", "a"]


def test_an_unknown_transport_is_reported_before_a_server_starts() -> None:
    app = typer.Typer()
    app.command()(act_path.main)
    done = CliRunner().invoke(app, ["--transports", "smoke"])
    assert done.exit_code == 2
    assert "smoke" in done.stderr
