"""Tables of episodes: the same values in each format, in columns that are documented."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from eval_fakes import LINE, OTHER_LINE
from in_process_evaluation import play

from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.exports import COLUMNS, to_csv, to_json, to_parquet
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.store import Store

Config = Callable[..., EvalConfig]
PAGE = Path(__file__).parents[3] / "docs" / "evaluation" / "results.md"


@pytest.fixture
def results(config: Config) -> Results:
    """Three episodes in two envs each, and one that infrastructure failed."""
    settings = config(envs=[LINE, OTHER_LINE], episodes=3, env_options={"camera": [32, 32]}, record="failures")
    play(settings, left_out=[2])
    with Store(settings.model_copy(update={"resume": True})) as store:
        store.begin_run(settings, {})
        key = next(job.key for job in plan(store.cells) if job.key.episode == 2)
        store.record(EpisodeResult(key, "infra_failed", error='env_failed: it hung, "again"'), attempts=4)
    return Results.load(settings.out)


def test_parquet_has_a_typed_row_an_episode(results: Results, tmp_path: Path) -> None:
    assert to_parquet(results, tmp_path / "episodes.parquet") == 5
    table = pq.read_table(tmp_path / "episodes.parquet")
    assert table.column_names == [column.name for column in COLUMNS]
    types = {name: str(table.schema.field(name).type) for name in ("success_once", "steps", "return", "finished")}
    assert types == {"success_once": "bool", "steps": "int64", "return": "double", "finished": "timestamp[us, tz=UTC]"}
    rows = table.to_pylist()
    assert [(row["env"], row["episode"], row["seed"]) for row in rows] == [
        (LINE, 0, 0), (LINE, 1, 1), (LINE, 2, 2), (OTHER_LINE, 0, 0), (OTHER_LINE, 1, 1)
    ]  # fmt: skip
    result = results.cells[0].episodes[0].result
    assert rows[0]["return"] == result.episode_return
    assert rows[0]["actions_sha256"] == result.actions_sha256
    assert json.loads(rows[0]["settings"])["env_options"] == {"camera": [32, 32]}
    assert (rows[2]["status"], rows[2]["success_once"]) == ("infra_failed", None)


def test_json_and_csv_hold_what_parquet_holds(results: Results, tmp_path: Path) -> None:
    to_parquet(results, tmp_path / "a.parquet")
    to_json(results, tmp_path / "a.json")
    to_csv(results, tmp_path / "a.csv")
    with (tmp_path / "a.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    objects = json.loads((tmp_path / "a.json").read_text())
    for row, line, one in zip(pq.read_table(tmp_path / "a.parquet").to_pylist(), lines, objects, strict=True):
        for column in COLUMNS:
            value, text, plain = row[column.name], line[column.name], one[column.name]
            if column.type == "json":
                assert json.loads(text) == json.loads(value) == plain
            elif column.type == "time":
                assert text == plain
                assert plain.startswith(value.isoformat()[:19])
            elif value is None:
                assert (text, plain) == ("", None)
            else:
                assert plain == value
                assert text == (str(value).lower() if column.type == "boolean" else str(value))


def test_every_field_of_a_result_has_a_column() -> None:
    renamed = {"episode_return": "return"}
    fields = {renamed.get(one.name, one.name) for one in dataclasses.fields(EpisodeResult)}
    assert fields <= {column.name for column in COLUMNS}


def test_the_documented_columns_are_those_that_are_written() -> None:
    documented = re.findall(r"^\| `(\w+)` \| (\w+) \| (.+) \|$", PAGE.read_text(), re.MULTILINE)
    assert documented == [(column.name, column.type, column.meaning) for column in COLUMNS]


def test_a_part_of_the_results_is_exported_alone(results: Results, tmp_path: Path) -> None:
    assert to_json(results.only(env=OTHER_LINE), tmp_path / "a.json") == 2
