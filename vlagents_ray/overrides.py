"""Changes of settings on a command line, in the notation of OmegaConf and Hydra, and a search for
files by name in a folder.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.errors import ConfigError, shown
from vlagents_ray.naming import did_you_mean
from vlagents_ray.yaml_text import load_yaml, read_yaml

YAML_SUFFIXES = (".yaml", ".yml")

_NOTATION = "KEY=VALUE, +KEY=VALUE or ~KEY, as in batch.max_size=8"
# A value that begins with one of these characters and is not YAML is an unfinished list, mapping or
# quotation, not plain text.
_YAML_BEGINNINGS = ("[", "{", '"', "'")


@dataclass(frozen=True, slots=True)
class Override:
    """One change of a document: `a.b=1`, `+a.b=1` or `~a.b`."""

    option: str  # the option that contains the change, for errors
    text: str  # the change as it was written, for errors
    # "set" changes or adds a value, "add" adds a new value, "remove" removes a value.
    change: Literal["set", "add", "remove"]
    path: tuple[str, ...]  # keys of mappings and indices of lists
    value: Any = None

    def below(self, *path: str) -> Override:
        """Return this change with `path` put before its keys."""
        return replace(self, path=(*path, *self.path))

    def error(self, message: str) -> ConfigError:
        """Return an error that names the option and the change."""
        return ConfigError(f"{self.option} {self.text}: {message}")


def parse_overrides(texts: Iterable[str], option: str) -> list[Override]:
    """Parse changes of settings.

    Args:
        texts: The changes. `a.b=1` sets a value, `a.0.b=1` sets a value in the first entry of a
            list, `+a.b=1` adds a new value, `+a.2=x` appends to a list of two entries, and `~a.b`
            removes a value. `++a.b=1` is `a.b=1`, as in Hydra. A value is YAML, such as `[1, 2]` or
            `true`; a value that is not YAML, such as `@handle`, is text, unless it begins like a
            list, a mapping or a quotation.
        option: The name of the option, for errors.

    Returns:
        The changes, in order.

    Raises:
        ConfigError: A text is not a change, or its value is not YAML.
    """
    return [_parse_override(text, option) for text in texts]


def _parse_override(text: str, option: str) -> Override:
    """Parse one change, see `parse_overrides`."""
    key, equals, value_text = text.partition("=")
    key = key.strip()
    change: Literal["set", "add", "remove"] = "set"
    if key.startswith("~"):
        change, key = "remove", key[1:]
    elif key.startswith("++"):
        key = key[2:]
    elif key.startswith("+"):
        change, key = "add", key[1:]

    path = tuple(key.split("."))
    if not all(path) or (change == "remove") == bool(equals):
        raise ConfigError(f"{option}: expected {_NOTATION}, got {text!r}")
    override = Override(option, text, change, path)
    if change == "remove":
        return override
    return replace(override, value=_parse_value(value_text, key, option))


def _parse_value(text: str, key: str, option: str) -> Any:
    """Return the value in a text, which is YAML or, unless it begins like YAML, plain text."""
    try:
        return load_yaml(text)
    except ValueError as error:
        if not text.lstrip().startswith(_YAML_BEGINNINGS):
            return text
        raise ConfigError(f"{option}: the value of {key!r} is not YAML ({error})") from error


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Return the settings that result from applying changes to an empty document.

    Args:
        texts: The changes, see `parse_overrides`.
        option: The name of the option, for errors.

    Returns:
        The settings, in which `a.b` is the key "b" of the mapping "a".

    Raises:
        ConfigError: A text is not a change, a value is not YAML, or a change is not possible.
    """
    return with_overrides({}, parse_overrides(texts, option))


def with_overrides(document: dict[str, Any], overrides: Iterable[Override]) -> dict[str, Any]:
    """Return a changed copy of a document.

    Args:
        document: The document, such as the content of a YAML file.
        overrides: The changes, which are applied in order.

    Returns:
        The changed document.

    Raises:
        ConfigError: A change adds a value that exists, removes a value that does not exist, or
            names a key below a value that is neither a mapping nor a list.
    """
    changed = copy.deepcopy(document)
    for override in overrides:
        _apply(changed, override)
    return changed


def _apply(document: dict[str, Any], override: Override) -> None:
    """Apply one change to a document."""
    section: Any = document
    for depth, name in enumerate(override.path[:-1]):
        key = _key_in(section, name, override)
        next_name = override.path[depth + 1]
        if _is_absent(section, key):
            if override.change == "remove":
                raise _missing(section, name, override)
            _insert(section, key, {}, override)
        elif section[key] is None and override.change != "remove":
            section[key] = {}  # an empty section of a file
        section = section[key]
        if not isinstance(section, dict | list):
            raise override.error(
                f"expected a mapping or a list at {name!r}, to set {next_name!r} in it, got "
                f"{shown(section)}"
            )

    name = override.path[-1]
    key = _key_in(section, name, override)
    if override.change == "remove":
        if _is_absent(section, key):
            raise _missing(section, name, override)
        del section[key]
    elif _is_absent(section, key):
        _insert(section, key, override.value, override)
    elif override.change == "add":
        raise override.error(
            f"expected a new key, got an existing key with the value {shown(section[key])}; leave "
            f"out the '+' to change the value"
        )
    else:
        section[key] = override.value


def _key_in(section: dict[Any, Any] | list[Any], name: str, override: Override) -> Any:
    """Return the key of a mapping, or the number of an entry of a list, that a name denotes.

    Raises:
        ConfigError: The section is a list, and the name is not a number.
    """
    if isinstance(section, dict):
        # The key may be a number, as in the YAML `8: 25.0`.
        for key in section:
            if str(key) == name:
                return key
        has_numbers = bool(section) and all(isinstance(key, int) for key in section)
        return int(name) if has_numbers and name.isdecimal() else name

    if not name.isdecimal():
        raise override.error(
            f"expected the number of an entry of a list, {_numbers(section)}, got {name!r}"
        )
    return int(name)


def _is_absent(section: dict[Any, Any] | list[Any], key: Any) -> bool:
    """Return whether a mapping lacks a key, or a list lacks an entry with this index."""
    if isinstance(section, dict):
        return key not in section
    return bool(key >= len(section))


def _insert(section: dict[Any, Any] | list[Any], key: Any, value: Any, override: Override) -> None:
    """Add a value to a mapping, or append it to a list.

    Raises:
        ConfigError: The section is a list, and the change does not append to it.
    """
    if isinstance(section, dict):
        section[key] = value
        return

    if override.change != "add" or key != len(section):
        raise override.error(
            f"expected the number of an entry of a list, {_numbers(section)}, got {key}; append an "
            f"entry with '+' and the number {len(section)}"
        )
    section.append(value)


def _missing(section: dict[Any, Any] | list[Any], name: str, override: Override) -> ConfigError:
    """Return the error for a key or entry that cannot be removed because it does not exist."""
    if isinstance(section, list):
        return override.error(
            f"expected the number of an entry of a list, {_numbers(section)}, got {name}"
        )
    keys = [str(key) for key in section]
    return override.error(
        f"expected an existing key, {keys or 'but there is none'}, got {name!r}"
        f"{did_you_mean(name, keys) or '; leave the change out'}"
    )


def _numbers(section: list[Any]) -> str:
    """Return the range of a list's indices in words."""
    return f"0 to {len(section) - 1}" if section else "which is empty"


def find_file(source: str, folder: Path | None, *, others: Collection[str] = ()) -> str:
    """Return the path of a file, which may be named without its folder and suffix.

    Args:
        source: A path; the name of a file in `folder`, with or without its suffix; or something
            else, such as the name of a policy.
        folder: The folder in which files are searched; None searches none.
        others: Names that are not files, which `source` may also be. A file of the same name has
            priority.

    Returns:
        The path of the file. The result is `source` itself if there is no folder, or if `source` is
        an existing path, one of `others`, a URL or "module:Class".

    Raises:
        ConfigError: The folder does not exist, or contains no such file.
    """
    if folder is None or Path(source).is_file():
        return source
    if not folder.is_dir():
        raise ConfigError(
            f"--config-dir: expected a folder, got {str(folder)!r}, which is none; check the path"
        )

    has_suffix = source.endswith(YAML_SUFFIXES)
    for suffix in ("",) if has_suffix else YAML_SUFFIXES:
        file = folder / f"{source}{suffix}"
        if file.is_file():
            return str(file)
    if ":" in source or source in others:
        return source

    names = sorted(file.name if has_suffix else file.stem for file in folder.glob("*.y*ml"))
    hint = did_you_mean(source, [*names, *others]) or "; check the name"
    raise ConfigError(
        f"{source!r}: expected a file in {folder}, one of {names or 'none'}, got a name that is "
        f"not there{hint}"
    )


def read_config_file(
    file: Path | str,
    noun: str,
    keys: str,
    *,
    overrides: Iterable[Override] = (),
    cure: str = "; check the path",
) -> dict[str, Any]:
    """Read a YAML file of settings, and apply changes to its content.

    Args:
        file: The file.
        noun: What the file is, for errors, such as "run file".
        keys: The usual keys of such a file, for errors, such as "`policies` and `suites`".
        overrides: The changes.
        cure: The end of the error for a missing file if no file has a similar name.

    Returns:
        The settings.

    Raises:
        ConfigError: The file does not exist or is not a mapping, or a change is not possible.
    """
    path = Path(file)
    if path.is_dir():
        raise ConfigError(
            f"{noun} {str(file)!r}: expected a file, got a folder; name a .yaml file in it"
        )
    if path.suffix not in YAML_SUFFIXES:
        raise ConfigError(f"{noun}: expected a .yaml file, got {str(file)!r}")
    if not path.is_file():
        neighbours = [str(other) for other in path.parent.glob("*.y*ml")]
        hint = did_you_mean(str(file), neighbours) or cure
        raise ConfigError(f"{noun} {path.absolute()} does not exist{hint}")

    document = read_yaml(path)
    if not isinstance(document, dict):
        kind = "an empty file" if document is None else type(document).__name__
        raise ConfigError(f"{file}: expected a mapping with {keys}, got {kind}")
    return with_overrides(document, overrides)
