"""Values written into the text of a YAML file, whose other lines and comments stay as they are."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from vlagents_ray.errors import ConfigError

Settings = Mapping[tuple[str, str], Any]  # by section and key below `args`, such as ("batch", "max_size")
Place = tuple[str | int, ...]  # keys of mappings and indices of lists, from the top


def with_settings_in_text(text: str, app: str, settings: Settings) -> str:
    """Return the text of a deployment file with other settings of one application; see `with_values_in_text`.

    Args:
        text: The YAML text.
        app: The application's name.
        settings: The settings.

    Raises:
        ConfigError: There is no such application.
    """
    applications = yaml.safe_load(text)["applications"]
    number = next((i for i, one in enumerate(applications) if one.get("name", "default") == app), None)
    if number is None:
        raise ConfigError(f"got no application {app!r} in the text of the deployment file")
    places: dict[Place, Any] = {("applications", number, "args", *place): value for place, value in settings.items()}
    return with_values_in_text(text, places)


def with_values_in_text(text: str, values: Mapping[Place, Any]) -> str:
    """Return a YAML text with other values at some places; all other lines and comments stay.

    A text whose places cannot be edited, such as one with an alias on the way, is written anew, without its comments.

    Args:
        text: The YAML text.
        values: The values by place; mappings on the way to the last key may be missing.
    """
    wanted = yaml.safe_load(text)
    for place, value in values.items():
        node: Any = wanted
        for part in place[:-1]:
            inner = node[part] if isinstance(part, int) else node.get(part)
            node[part] = list(inner) if isinstance(inner, list) else dict(inner or {})  # its own, if it was an alias
            node = node[part]
        node[place[-1]] = value
        text = _edited(text, place, _flow(value))
    try:
        if yaml.safe_load(text) == wanted:
            return text
    except yaml.YAMLError:
        pass
    return yaml.safe_dump(wanted, sort_keys=False)


def with_comments(text: str, lines: Sequence[str], table: Sequence[Sequence[str]]) -> str:
    """Return a YAML text with comments in front of it: lines, then a table whose first row is its head."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in table]
    return "".join(f"# {line}".rstrip() + "\n" for line in [*lines, *rows]) + "\n" + text


def _edited(text: str, place: Place, value: str) -> str:
    node: Any = yaml.compose(text, yaml.SafeLoader)
    for depth, part in enumerate(place):
        if isinstance(part, int):
            node = node.value[part]
            continue
        rest = value
        for key in reversed(place[depth + 1 :]):
            rest = f"{{{key}: {rest}}}"
        inner = _value(node, part)
        if inner is None:
            return _inserted(text, node, part, rest)
        if depth == len(place) - 1 or not isinstance(inner, yaml.CollectionNode):  # the last key, or nothing, or null
            return _replaced(text, node, part, rest)
        node = inner
    raise ValueError(f"place: got {place}, want a key at its end")


def _value(mapping: Any, key: str) -> Any:
    """Return the node of a key's value; None without such a key."""
    return next((value for name, value in mapping.value if name.value == key), None)


def _inserted(text: str, mapping: Any, key: str, value: str) -> str:
    """Return the text with a further key in front of a mapping's others."""
    start = mapping.start_mark
    if mapping.flow_style:
        comma = ", " if mapping.value else ""
        return f"{text[: start.index + 1]}{key}: {value}{comma}{text[start.index + 1 :]}"
    return f"{text[: start.index]}{key}: {value}\n{' ' * start.column}{text[start.index :]}"


def _replaced(text: str, mapping: Any, key: str, value: str) -> str:
    name, old = next((name, old) for name, old in mapping.value if name.value == key)
    if isinstance(old, yaml.ScalarNode) and old.end_mark.index > old.start_mark.index:
        return text[: old.start_mark.index] + value + text[old.end_mark.index :]
    return f"{text[: name.end_mark.index]}: {value}{text[max(_end(old), name.end_mark.index + 1) :]}"


def _end(node: Any) -> int:
    """Return the index of the end of a node's own text; the mark of a block is behind the comments after it."""
    if isinstance(node, yaml.ScalarNode) or node.flow_style or not node.value:
        return int(node.end_mark.index)
    last = node.value[-1]
    return _end(last[1] if isinstance(last, tuple) else last)


def _flow(value: Any) -> str:
    """Return a value on one line; JSON of booleans, numbers, names and lists is YAML."""
    return value if isinstance(value, str) else json.dumps(value)
