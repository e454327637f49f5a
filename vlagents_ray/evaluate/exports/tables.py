"""A row an episode, as JSON, CSV or Parquet."""

from __future__ import annotations

import csv
import json
from datetime import datetime
from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.config import canonical
from vlagents_ray.evaluate.exports.columns import COLUMNS, rows
from vlagents_ray.evaluate.files import whole
from vlagents_ray.evaluate.results import Results
from vlagents_ray.registry import require

_JSON = {column.name for column in COLUMNS if column.type == "json"}


def to_json(results: Results, path: Path) -> int:
    """Write a list of objects; times are ISO 8601, in UTC. Returns how many."""
    found = list(rows(results))
    with whole(path) as part:
        part.write_text(json.dumps(found, indent=1, default=_text, ensure_ascii=False) + "\n", encoding="utf-8")
    return len(found)


def to_csv(results: Results, path: Path) -> int:
    """Write a line an episode below one of names: nothing is an empty field, truth is `true` or `false`."""
    number = 0
    with whole(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [column.name for column in COLUMNS])
        writer.writeheader()
        for number, row in enumerate(rows(results), 1):  # noqa: B007 - the last one counts
            writer.writerow({name: _field(value, name in _JSON) for name, value in row.items()})
    return number


def to_parquet(results: Results, path: Path) -> int:
    """Write a typed table; what is nested is JSON text. Needs the extra "record"."""
    pa: Any = require("pyarrow")
    types = {
        "string": pa.string(), "integer": pa.int64(), "number": pa.float64(), "boolean": pa.bool_(),
        "time": pa.timestamp("us", "UTC"), "json": pa.string(),
    }  # fmt: skip
    fields = [pa.field(one.name, types[one.type], metadata={"meaning": one.meaning}) for one in COLUMNS]
    found = [
        {name: canonical(value) if name in _JSON else value for name, value in row.items()} for row in rows(results)
    ]
    with whole(path) as part:
        require("pyarrow.parquet").write_table(pa.Table.from_pylist(found, pa.schema(fields)), part)
    return len(found)


def _text(value: object) -> str:
    if isinstance(value, datetime):
        return value.isoformat()
    raise TypeError(f"{type(value).__name__} is not JSON")


def _field(value: object, nested: bool) -> object:
    if nested:
        return canonical(value)
    if isinstance(value, bool):
        return str(value).lower()
    return _text(value) if isinstance(value, datetime) else value
