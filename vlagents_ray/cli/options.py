"""Common options of commands, and parsers for `KEY=VALUE`, lists and times."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import inspect
import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import typer
from pydantic import ValidationError
from typer.core import TyperGroup

from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.settings import wrong_settings
from vlagents_ray.yaml_text import load_yaml, read_yaml

YAML_SUFFIXES = (".yaml", ".yml")

Set = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of the policy; may be repeated."),
]
Address = Annotated[
    str | None,
    typer.Option(
        help="A running Ray cluster, where 'auto' finds the one of `ray start`, or the URL of a "
        "local server, to use its Ray cluster; default: a new cluster on this machine, for the run."
    ),
]

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]
Live = Annotated[
    bool,
    typer.Option(
        "--live", help="Show the progress on a live page for the browser, at 127.0.0.1:8050."
    ),
]
LiveAt = Annotated[
    str | None,
    typer.Option(
        "--live-at",
        metavar="HOST:PORT",
        help="Like --live, at this address; an address that other machines reach needs API keys.",
    ),
]

StateDims = Annotated[
    list[str],
    typer.Option(
        "--state-dim",
        metavar="PART=N",
        help="Number of values in a part of the state, if the policy does not declare it.",
    ),
]
_MOST_DIMS = 1_000_000  # most numbers in a part of the state
_Options = TypeVar("_Options")


def command_of(
    options: type[_Options],
) -> Callable[[Callable[[_Options], None]], Callable[..., None]]:
    """Return a decorator that makes a command for Typer from a function that takes its options as
    one object.

    Args:
        options: The dataclass of the options. Each field is annotated with its `typer.Option` or
            `typer.Argument`.
    """
    hints = get_type_hints(options, include_extras=True)
    parameters = []
    for field in dataclasses.fields(options):  # type: ignore[arg-type]
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        elif field.default is not dataclasses.MISSING:
            default = field.default
        else:
            default = inspect.Parameter.empty
        parameter = inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=default,
            annotation=hints[field.name],
        )
        parameters.append(parameter)

    def decorate(command: Callable[[_Options], None]) -> Callable[..., None]:
        """Return the command as a function that takes each option as an argument."""

        @functools.wraps(command)
        def run(**values: Any) -> None:
            command(options(**values))

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {}
        return run

    return decorate


class Commands(TyperGroup):
    """The group of all commands, whose errors name the value of an option that cannot be read."""

    def invoke(self, ctx: Any) -> Any:
        """Run a command, as Typer does."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            if isinstance(error.__cause__, ValidationError):  # its message lacks the value
                error.message = wrong_settings(error.__cause__)
            raise


def finite(value: float | None) -> float | None:
    """Reject NaN and infinity, for Typer, whose bounds accept them.

    Args:
        value: The value of an option.

    Returns:
        The value.

    Raises:
        typer.BadParameter: The value is not a finite number.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"expected a finite number, got {value}")
    return value


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Parse texts such as `a.b=1` to nested settings.

    Args:
        texts: The texts, KEY=VALUE. The value is YAML, such as `[1, 2]` or `true`. A value that is
            not YAML, such as `@handle`, is text, unless it begins like a list, a mapping or a
            quotation.
        option: The name of the option, for errors.

    Returns:
        The settings, in which `a.b` is the key "b" of the mapping "a".

    Raises:
        ConfigError: A text is not KEY=VALUE, a key is below another value, or a value is not YAML.
    """
    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ConfigError(f"{option}: expected KEY=VALUE, as in batch.max_size=8, got {text!r}")

        section = settings
        for name in path[:-1]:
            section = section.setdefault(name, {})
            if not isinstance(section, dict):
                raise ConfigError(
                    f"{option}: {key!r} goes below {name!r}, which has a value already"
                )

        try:
            section[path[-1]] = load_yaml(value)
        except ValueError as error:
            if not value.lstrip().startswith(("[", "{", '"', "'")):
                section[path[-1]] = value
                continue
            raise ConfigError(f"{option}: the value of {key!r} is not YAML ({error})") from error
    return settings


def parse_dims(texts: Iterable[str], option: str) -> dict[str, int]:
    """Parse the sizes of parts of the state.

    Args:
        texts: The texts, PART=N.
        option: The name of the option, for errors.

    Returns:
        The number of numbers in each part.

    Raises:
        ConfigError: A size is not a whole number above 0.
    """
    dims = parse_settings(texts, option)
    for number in dims.values():
        if type(number) is not int or not 1 <= number <= _MOST_DIMS:
            raise ConfigError(
                f"{option}: expected a whole number from 1 to {_MOST_DIMS} for each part, got "
                f"{dims}"
            )
    return dims


def parse_list(text: str) -> list[str]:
    """Split a text at commas, without empty items."""
    return [item.strip() for item in text.split(",") if item.strip()]


def parse_time(text: str, option: str) -> float:
    """Parse a time.

    Args:
        text: Seconds since 1970, or a date and time of day in ISO 8601, which is local unless it
            has a zone.
        option: The name of the option, for errors.

    Returns:
        The time, s since 1970.

    Raises:
        ConfigError: The text is not a time.
    """
    try:
        with contextlib.suppress(ValueError):
            # This also rejects a time beyond the calendar.
            return datetime.datetime.fromtimestamp(float(text)).timestamp()
        return datetime.datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise ConfigError(
            f"{option}: expected seconds since 1970, or a time such as 2027-01-31T18:30, got "
            f"{text!r}"
        ) from error


def read_run_file(file: Path, noun: str, keys: str) -> dict[str, Any]:
    """Read a YAML file with the settings of a run.

    Args:
        file: The file.
        noun: A name of this type of file, for errors, such as "file of runs".
        keys: The keys that such a file has, for errors.

    Returns:
        The settings. `out` is runs/NAME, unless the file names a folder.

    Raises:
        ConfigError: The file does not exist, or is not a mapping.
    """
    if file.is_dir():
        raise ConfigError(
            f"{noun} {str(file)!r}: expected a file, got a folder; name a .yaml file in it"
        )
    if not file.is_file():
        neighbours = [str(other) for other in file.parent.glob("*.y*ml")]
        hint = did_you_mean(str(file), neighbours) or "; check the path"
        raise ConfigError(f"{noun} {str(file)!r} does not exist{hint}")
    document = read_yaml(file)
    if not isinstance(document, dict):
        found = "an empty file" if document is None else type(document).__name__
        raise ConfigError(f"{file}: expected a mapping with {keys}, got {found}")
    return {"out": Path("runs") / file.stem} | document
