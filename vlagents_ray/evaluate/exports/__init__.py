"""Results for other programs: tables of episodes, datasets of their steps, and scores for the Hub."""

from collections.abc import Callable

from vlagents_ray.evaluate.exports.lerobot import to_lerobot
from vlagents_ray.evaluate.exports.scores import to_hub
from vlagents_ray.evaluate.exports.tables import COLUMNS, Column, rows, to_csv, to_json, to_parquet

EXPORTS: dict[str, Callable[..., int]] = {
    "json": to_json,
    "csv": to_csv,
    "parquet": to_parquet,
    "lerobot": to_lerobot,
    "hub": to_hub,
}

__all__ = ["COLUMNS", "EXPORTS", "Column", "rows", "to_csv", "to_hub", "to_json", "to_lerobot", "to_parquet"]
