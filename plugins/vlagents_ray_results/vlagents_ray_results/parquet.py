"""Writes the table of episodes as Parquet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlagents_ray.evaluate.artifacts.storage import require_folder_of, whole
from vlagents_ray.evaluate.exports import COLUMNS, rows
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.registry import require


def to_parquet(results: Results, path: Path) -> int:
    """Write a typed table, in which nested values are JSON text, and return the number of
    episodes.
    """
    require_folder_of(path)
    pa: Any = require("pyarrow")
    types = {
        "string": pa.string(), "integer": pa.int64(), "number": pa.float64(), "boolean": pa.bool_(),
        "time": pa.timestamp("us", "UTC"), "json": pa.string(),
    }  # fmt: skip
    fields = [
        pa.field(column.name, types[column.type], metadata={"meaning": column.meaning})
        for column in COLUMNS
    ]
    table_rows = list(rows(results, flat=True))
    with whole(path) as unfinished:
        require("pyarrow.parquet").write_table(
            pa.Table.from_pylist(table_rows, pa.schema(fields)), unfinished
        )
    return len(table_rows)
