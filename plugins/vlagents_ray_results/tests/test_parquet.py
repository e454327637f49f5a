"""Tests of the table of episodes as Parquet."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from eval_fakes import LINE, OTHER_LINE
from exported_results import SETTINGS, with_a_lost_episode

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.exports import COLUMNS, rows
from vlagents_ray_results.parquet import to_parquet

Config = Callable[..., EvalConfig]


@pytest.fixture
def results(config: Config) -> Results:
    return with_a_lost_episode(config(**SETTINGS))


def test_parquet_has_a_typed_row_an_episode(results: Results, tmp_path: Path) -> None:
    assert to_parquet(results, tmp_path / "episodes.parquet") == 5
    table = pq.read_table(tmp_path / "episodes.parquet")
    assert table.column_names == [column.name for column in COLUMNS]
    types = {
        name: str(table.schema.field(name).type)
        for name in ("success_once", "steps", "return", "finished")
    }
    assert types == {
        "success_once": "bool",
        "steps": "int64",
        "return": "double",
        "finished": "timestamp[us, tz=UTC]",
    }
    rows = table.to_pylist()
    assert [(row["env"], row["episode"], row["seed"]) for row in rows] == [
        (LINE, 0, 0), (LINE, 1, 1), (LINE, 2, 2), (OTHER_LINE, 0, 0), (OTHER_LINE, 1, 1)
    ]  # fmt: skip
    result = results.cases[0].episodes[0].result
    assert rows[0]["return"] == result.episode_return
    assert rows[0]["actions_sha256"] == result.actions_sha256
    assert json.loads(rows[0]["settings"])["env_options"] == {"camera": [32, 32]}
    assert (rows[2]["status"], rows[2]["success_once"]) == ("infra_failed", None)


def test_parquet_holds_the_values_of_each_episode(results: Results, tmp_path: Path) -> None:
    to_parquet(results, tmp_path / "a.parquet")
    for read, row in zip(
        pq.read_table(tmp_path / "a.parquet").to_pylist(), rows(results), strict=True
    ):
        for column in COLUMNS:
            value = read[column.name]
            if column.type == "json":
                value = json.loads(value)
                assert value == json.loads(json.dumps(row[column.name]))
            else:
                assert value == row[column.name]


def test_a_table_is_a_file_in_a_folder_that_exists(results: Results, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a file in an existing folder"):
        to_parquet(results, tmp_path / "missing" / "a.parquet")
