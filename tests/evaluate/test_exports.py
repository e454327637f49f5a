"""Tables of episodes: the same values in each format, and documented columns."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from eval_fakes import OTHER_LINE
from exported_results import SETTINGS, with_a_lost_episode

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.exports import COLUMNS, rows, to_csv, to_json

Config = Callable[..., EvalConfig]


@pytest.fixture
def results(config: Config) -> Results:
    return with_a_lost_episode(config(**SETTINGS))


def test_json_and_csv_hold_the_values_of_each_episode(results: Results, tmp_path: Path) -> None:
    assert to_json(results, tmp_path / "a.json") == to_csv(results, tmp_path / "a.csv") == 5
    with (tmp_path / "a.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    objects = json.loads((tmp_path / "a.json").read_text())
    for row, line, written in zip(rows(results), lines, objects, strict=True):
        for column in COLUMNS:
            value, text, plain = row[column.name], line[column.name], written[column.name]
            if column.type == "json":
                assert json.loads(text) == plain == json.loads(json.dumps(value))
            elif column.type == "time":
                assert text == plain == value.isoformat()
            elif value is None:
                assert (text, plain) == ("", None)
            else:
                assert plain == value
                assert text == (str(value).lower() if column.type == "boolean" else str(value))


@pytest.mark.parametrize("write", [to_json, to_csv])
def test_a_table_is_a_file_in_a_folder_that_exists(
    results: Results, tmp_path: Path, write: Callable[[Results, Path], int]
) -> None:
    with pytest.raises(ConfigError, match="expected a file, got a folder"):
        write(results, tmp_path)
    with pytest.raises(ConfigError, match="expected a file in an existing folder"):
        write(results, tmp_path / "missing" / "a.csv")


def test_every_field_of_a_result_has_a_column() -> None:
    renamed = {"episode_return": "return"}
    fields = {renamed.get(one.name, one.name) for one in dataclasses.fields(EpisodeResult)}
    assert fields <= {column.name for column in COLUMNS}


def test_a_part_of_the_results_is_exported_alone(results: Results, tmp_path: Path) -> None:
    assert to_json(results.only(env=OTHER_LINE), tmp_path / "a.json") == 2
