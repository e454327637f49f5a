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
from vlagents_ray.settings import wrong_settings
from vlagents_ray.yaml_text import load_yaml, read_yaml

YAML_SUFFIXES = (".yaml", ".yml")

Set = Annotated[
    list[str],
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of the policy, repeatable."),
]
Address = Annotated[
    str | None,
    typer.Option(
        help="A running Ray cluster ('auto' finds that of `ray start`), or the URL of a server on "
        "this machine, for the one it has; default: one for the run, on this machine."
    ),
]

AsJson = Annotated[bool, typer.Option("--json", help="As JSON, for programs.")]
Live = Annotated[
    bool,
    typer.Option(
        "--live", help="Serve a page in the browser that fills up as it runs, on 127.0.0.1:8050."
    ),
]
LiveAt = Annotated[
    str | None,
    typer.Option(
        "--live-at",
        metavar="HOST:PORT",
        help="The same there; beyond this machine it needs API keys.",
    ),
]

StateDims = Annotated[
    list[str],
    typer.Option(
        "--state-dim", metavar="PART=N", help="Numbers in a part, where the policy does not say."
    ),
]
_MOST_DIMS = 1_000_000  # numbers in a part of the state
_Options = TypeVar("_Options")


def command_of(
    options: type[_Options],
) -> Callable[[Callable[[_Options], None]], Callable[..., None]]:
    """Make a command for Typer from a function that takes its options as one object.

    Each field of the dataclass `options` is annotated with its `typer.Option` or `typer.Argument`.
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
    """Return the value of an option, for Typer, whose bounds accept a number that is not one;
    that is an error here.
    """
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"expected a finite number, got {value}")
    return value


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Parse texts such as `a.b=1` to nested settings; the value is YAML, so `[1, 2]` and `true`
    work.

    A value that is not YAML, such as `@handle`, is text, unless it begins like a list, a mapping or
    a quotation.
    """
    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        path = key.strip().split(".")
        if not equals or not all(path):
            raise ConfigError(f"{option}: got {text!r}, want KEY=VALUE, as in batch.max_size=8")

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
    """Parse `PART=N`, the numbers in parts of the state."""
    dims = parse_settings(texts, option)
    if not all(type(number) is int and 1 <= number <= _MOST_DIMS for number in dims.values()):
        raise ConfigError(
            f"{option}: expected a whole number from 1 to {_MOST_DIMS} for each part, got {dims}"
        )
    return dims


def parse_list(text: str) -> list[str]:
    """Split at commas; empty items are left out."""
    return [item.strip() for item in text.split(",") if item.strip()]


def parse_time(text: str, option: str) -> float:
    """Parse seconds since 1970, or a date and time of day (local unless it has a zone), to
    seconds since 1970.
    """
    try:
        with contextlib.suppress(ValueError):
            return datetime.datetime.fromtimestamp(float(text)).timestamp()  # within the calendar
        return datetime.datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise ConfigError(
            f"{option}: expected seconds since 1970, or a time such as 2027-01-31T18:30, got "
            f"{text!r}"
        ) from error


def read_run_file(file: Path, kind: str, keys: str) -> dict[str, Any]:
    """Read a YAML file of the settings of a run; results go to runs/NAME unless it names a
    folder.
    """
    if file.is_dir():
        raise ConfigError(
            f"{kind} {str(file)!r}: expected a file, got a folder; name a .yaml file in it"
        )
    if not file.is_file():
        raise ConfigError(f"{kind} {str(file)!r} does not exist")
    document = read_yaml(file)
    if not isinstance(document, dict):
        raise ConfigError(f"{file}: got {type(document).__name__}, want a mapping with {keys}")
    return {"out": Path("runs") / file.stem} | document
