"""Settings written into the text of a deployment file, whose other lines and comments stay as they are."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from vlagents_ray.errors import ConfigError

Settings = Mapping[tuple[str, str], Any]  # by section and key below `args`, such as ("batch", "max_size")


def with_settings_in_text(text: str, app: str, settings: Settings) -> str:
    """Return the text of a deployment file with other settings of one application.

    A text whose places cannot be edited, such as one with an alias for `args`, is written anew, without its comments.

    Args:
        text: The YAML text.
        app: The application's name.
        settings: The settings.
    """
    wanted = yaml.safe_load(text)
    application = _application(wanted["applications"], app)
    args = application["args"] = dict(application["args"])  # its own, if it was an alias
    for (section, key), value in settings.items():
        args[section] = {**(args.get(section) or {}), key: value}
    for (section, key), value in settings.items():
        text = _edited(text, app, section, key, _flow(value))
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


def _application(applications: list[dict[str, Any]], app: str) -> dict[str, Any]:
    for one in applications:
        if one.get("name", "default") == app:
            return one
    raise ConfigError(f"got no application {app!r} in the text of the deployment file")


def _edited(text: str, app: str, section: str, key: str, value: str) -> str:
    applications = _value(yaml.compose(text, yaml.SafeLoader), "applications")
    args = next(
        _value(one, "args") for one in applications.value if getattr(_value(one, "name"), "value", "default") == app
    )
    inner = _value(args, section)
    if inner is None:
        return _inserted(text, args, section, f"{{{key}: {value}}}")
    if not isinstance(inner, yaml.MappingNode):  # nothing, or null
        return _replaced(text, args, section, f"{{{key}: {value}}}")
    if _value(inner, key) is None:
        return _inserted(text, inner, key, value)
    return _replaced(text, inner, key, value)


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
