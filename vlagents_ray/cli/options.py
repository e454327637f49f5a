"""Common options of commands, and parsers for lists and times."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import datetime
import functools
import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import typer
from pydantic import ValidationError

from vlagents_ray.cli.typer_help import HelpGroup
from vlagents_ray.errors import ConfigError
from vlagents_ray.overrides import (
    YAML_SUFFIXES,
    Override,
    find_file,
    parse_overrides,
    read_config_file,
    with_overrides,
)
from vlagents_ray.registry import names
from vlagents_ray.settings import wrong_settings

Set = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A setting of the policy, also one in its deployment file: KEY=VALUE sets it, "
        "+KEY=VALUE adds a new one, and ~KEY removes it. May be repeated.",
    ),
]
SetInFile = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A change of the file: KEY=VALUE sets a value, +KEY=VALUE adds a new one, and ~KEY "
        "removes one. May be repeated.",
    ),
]
ServeSet = Annotated[
    list[str],
    typer.Option(
        "--serve-set",
        metavar="KEY=VALUE",
        help="A setting of the server, such as batch.max_size=8: KEY=VALUE, +KEY=VALUE or ~KEY. "
        "May be repeated.",
    ),
]
ConfigDir = Annotated[
    Path | None,
    typer.Option(
        "--config-dir",
        metavar="DIR",
        help="Folder of files that are given by name: NAME is DIR/NAME.yaml.",
    ),
]
Address = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="A running Ray cluster: its address, 'auto' for the cluster of `ray start`, or the "
        "URL of a local server, to use its cluster; default: a new cluster on this machine, for "
        "the run.",
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
        help="Like --live, at this address. An address that other machines reach needs API keys.",
    ),
]
_Options = TypeVar("_Options")


def command_of(
    options: type[_Options], panels: Mapping[str, Sequence[str]] = MappingProxyType({})
) -> Callable[[Callable[[_Options], None]], Callable[..., None]]:
    """Return a decorator that makes a Typer command from a function that accepts its options as one
    object.

    Args:
        options: The dataclass of the options. Each field is annotated with its `typer.Option` or
            `typer.Argument`.
        panels: The fields that each panel of the help shows, by the title of the panel; all other
            fields are in the panel "Options".
    """
    hints = get_type_hints(options, include_extras=True)
    for title, names_of_fields in panels.items():
        for name in names_of_fields:
            hints[name] = _in_panel(hints[name], title)
    in_order = list(itertools.chain.from_iterable(panels.values()))
    fields = sorted(  # arguments, and options that are in no panel, are first
        dataclasses.fields(options),  # type: ignore[arg-type]
        key=lambda field: in_order.index(field.name) if field.name in in_order else -1,
    )
    parameters = []
    for field in fields:
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
        """Return the command as a function with a parameter for each option."""

        @functools.wraps(command)
        def run(**values: Any) -> None:
            command(options(**values))

        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {}
        return run

    return decorate


def _in_panel(hint: Any, title: str) -> Any:
    """Return a copy of an annotation whose `typer.Option` is shown in a panel of the help."""
    hinted_type, *metadata = get_args(hint)
    # Copy the option, since several commands may share the annotation.
    in_panel = [copy.copy(data) for data in metadata]
    for data in in_panel:
        data.rich_help_panel = title
    return Annotated[(hinted_type, *in_panel)]


class Commands(HelpGroup):
    """The group of all commands; its errors contain the value of an option that cannot be
    parsed.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run a command, as Typer does."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            if isinstance(error.__cause__, ValidationError):  # Typer's message lacks the value
                error.message = wrong_settings(error.__cause__)
            raise


def finite(value: float | None) -> float | None:
    """Reject NaN and infinity, which Typer's bounds accept.

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


def policy_overrides(settings: Iterable[str], serve_settings: Iterable[str]) -> list[Override]:
    """Parse the changes of a deployment's `args` on a command line.

    Args:
        settings: The values of `--set`, which change the policy's own settings.
        serve_settings: The values of `--serve-set`, which change the other settings in `args`.

    Returns:
        The changes of `args`, see `read_deployment`.

    Raises:
        ConfigError: A value cannot be parsed, or --serve-set contains settings of the policy.
    """
    overrides = parse_overrides(serve_settings, "--serve-set")
    for override in overrides:
        if override.path[0] == "config":
            raise ConfigError(
                "--serve-set: expected settings of the deployment, got `config`; give the "
                "policy's settings with --set"
            )
    overrides += [override.below("config") for override in parse_overrides(settings, "--set")]
    return overrides


def find_policy(source: str, config_dir: Path | None) -> str:
    """Return the deployment file that `source` names in the folder `config_dir`, or `source` if it
    is another policy.

    Raises:
        ConfigError: Neither a file nor a policy has this name.
    """
    return find_file(source, config_dir, others=names("policies"))


def changed_settings(source: str | None, overrides: Sequence[Override]) -> dict[str, Any]:
    """Return the settings of a policy after the changes of `--set`.

    Args:
        source: The policy.
        overrides: The changes of the policy's settings, or of the settings in its deployment file.

    Returns:
        The changed settings; for a deployment file with changes, all settings of the file.

    Raises:
        ConfigError: A change is not possible, or removes a setting of a deployment file.
    """
    if not overrides or source is None or not source.endswith(YAML_SUFFIXES):
        return with_overrides({}, overrides)

    from vlagents_ray.serve.launch.deployment_file import settings_in_file

    settings = settings_in_file(source)
    changed = with_overrides(settings, overrides)
    removed = sorted(settings.keys() - changed.keys())
    if removed:
        raise ConfigError(
            f"--set: expected values for the settings of {source}, got {removed} removed; remove "
            "them in the file"
        )
    return changed


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


def read_run_file(
    file: Path | str, noun: str, keys: str, overrides: Iterable[Override] = ()
) -> dict[str, Any]:
    """Read a YAML file with the settings of a run, and apply changes to the settings.

    Args:
        file: The file.
        noun: The type of the file, for errors, such as "run file".
        keys: The usual keys of such a file, for errors.
        overrides: The changes, as `parse_overrides` returns them.

    Returns:
        The settings; `out` is runs/NAME, unless the file contains a folder.

    Raises:
        ConfigError: The file does not exist or is not a mapping, or a change is not possible.
    """
    document = read_config_file(file, noun, keys, overrides=overrides)
    return {"out": Path("runs") / Path(file).stem} | document
