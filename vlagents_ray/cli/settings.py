"""`--set key=value` and lists on the command line."""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from typing import Any

import yaml

from vlagents_ray.errors import ConfigError


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Nested settings from `a.b=1` and the like; the value is YAML, so `[1, 2]` and `true` work."""
    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ConfigError(f"{option}: got {text!r}, want KEY=VALUE, as in batch.max_size=8")
        place = settings
        for name in path[:-1]:
            place = place.setdefault(name, {})
            if not isinstance(place, dict):
                raise ConfigError(f"{option}: {key!r} goes below {name!r}, which has a value already")
        try:
            place[path[-1]] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"{option}: the value of {key!r} is not YAML ({error})") from error
    return settings


def parse_list(text: str) -> list[str]:
    """What stands between commas."""
    return [one.strip() for one in text.split(",") if one.strip()]


def parse_counts(text: str, option: str) -> list[int]:
    """Numbers from 1 on with commas between them, ascending."""
    try:
        counts = sorted({int(one) for one in parse_list(text)})
    except ValueError as error:
        raise ConfigError(f"{option}: got {text!r}, want numbers with commas between them") from error
    if not counts or counts[0] < 1:
        raise ConfigError(f"{option}: got {text!r}, want numbers from 1 on")
    return counts


def parse_time(text: str, option: str) -> float:
    """A point in time, in seconds since 1970: those, or a date and time of day, local unless it says otherwise."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        return datetime.datetime.fromisoformat(text).timestamp()
    except ValueError as error:
        raise ConfigError(f"{option}: got {text!r}, want seconds since 1970, or as in 2027-01-31T18:30") from error
