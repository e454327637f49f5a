"""Results for other programs: tables with one row an episode, and datasets with one row a step."""

from vlagents_ray.evaluate.exports.columns import COLUMNS, Column, rows
from vlagents_ray.evaluate.exports.lerobot import to_lerobot
from vlagents_ray.evaluate.exports.tables import to_csv, to_json, to_parquet

EXPORTS = {"json": to_json, "csv": to_csv, "parquet": to_parquet, "lerobot": to_lerobot}

__all__ = ["COLUMNS", "EXPORTS", "Column", "rows", "to_csv", "to_json", "to_lerobot", "to_parquet"]
