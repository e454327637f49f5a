"""Results for other programs: tables of episodes, and datasets of their steps."""

from collections.abc import Callable

from vlagents_ray.evaluate.exports.lerobot import to_lerobot
from vlagents_ray.evaluate.exports.tables import COLUMNS, Column, rows, to_csv, to_json, to_parquet

EXPORTS: dict[str, Callable[..., int]] = {
    "json": to_json,
    "csv": to_csv,
    "parquet": to_parquet,
    "lerobot": to_lerobot,
}

__all__ = ["COLUMNS", "EXPORTS", "Column", "rows", "to_csv", "to_json", "to_lerobot", "to_parquet"]
