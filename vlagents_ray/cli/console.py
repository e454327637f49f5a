"""The console of all commands, and its error messages."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import typer
from pydantic import BaseModel, ValidationError
from rich.console import Console, ConsoleDimensions, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from vlagents_ray.errors import ClusterLost, ConfigError, VLAgentsError
from vlagents_ray.settings import wrong_settings
from vlagents_ray.signals import interrupts


class PlainConsole(Console):
    """A console that prints text unchanged, so that it can be copied: `[serve]` is not markup,
    `:boat:` is not an emoji, and lines are not cut.

    Styled output is a `Text`, or has a `style`. On a terminal, a table is as wide as the terminal,
    and words that are too long for a cell are broken; elsewhere a table is as wide as its content.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, soft_wrap=True, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render without control characters, since the text may come from a server or from the
        results of another person.
        """
        for segment in super().render(renderable, options):
            is_plain = segment.text.isprintable() or segment.text == "\n"
            if segment.control is not None or is_plain:
                yield segment
            else:
                yield Segment(_without_controls(segment.text), segment.style)

    @property  # type: ignore[misc]
    def size(self) -> ConsoleDimensions:
        """The size in columns and lines; a file or a pipe is unbounded."""
        size = super().size
        return size if self.is_terminal else size._replace(width=10_000)


def _without_controls(text: str) -> str:
    """Replace the control characters of a text, except newlines and tabs."""
    characters = []
    for character in text:
        is_shown = character.isprintable() or character in "\n\t"
        characters.append(character if is_shown else "�")
    return "".join(characters)


def table(*columns: str, **options: Any) -> Table:
    """Make an empty table that does not cut text off.

    Args:
        columns: The titles of the columns.
        options: Further arguments of `rich.table.Table`.
    """
    empty = Table(**options)
    for column in columns:
        empty.add_column(column, overflow="fold")
    return empty


out = PlainConsole()
err = PlainConsole(stderr=True)


@contextlib.contextmanager
def errors(*settings: type[BaseModel]) -> Iterator[None]:
    """Print an error of this package as one message on stderr, and end the command with an exit
    code: 2 for wrong settings, 130 for Ctrl-C, else 1.

    SIGTERM has the effect of Ctrl-C, so that processes that the command has started are shut down
    properly.

    Args:
        settings: Further pydantic models of settings that a user writes. If a field is unknown, the
            message lists the fields of its model.
    """
    try:
        with interrupts():
            yield
    except ValidationError as error:
        from vlagents_ray.evaluate import EvalConfig

        models: tuple[type[BaseModel], ...] = (EvalConfig, *settings)
        model = next((model for model in models if model.__name__ == error.title), None)
        fail(f"wrong settings: {wrong_settings(error, model)}", 2)
    except ConfigError as error:
        fail(str(error), 2)
    except ClusterLost as error:
        with open(os.dup(2), "w") as stderr, open(os.devnull, "w") as nowhere:
            # Ray's native threads write to stderr until the process ends.
            os.dup2(nowhere.fileno(), 2)
            say_error(f"{type(error).__name__}: {error}", PlainConsole(file=stderr))
        raise typer.Exit(1) from error
    except VLAgentsError as error:
        fail(f"{type(error).__name__}: {error}", 1)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            fail(f"the disk is full ({error.strerror}); make room, and repeat the command", 1)
        if error.filename is None:
            raise
        fail(
            f"{error.filename}: cannot be used: {error.strerror}; choose another path, or change "
            "its permissions",
            1,
        )
    except KeyboardInterrupt as error:
        fail(str(error) or "interrupted", 130)


def fail(message: str, code: int) -> NoReturn:
    """Print an error, and end the process with `code`."""
    say_error(message)
    raise typer.Exit(code)


def say_error(message: str, console: Console | None = None) -> None:
    """Print an error after all other output."""
    sys.stdout.flush()
    (console or err).print(Text.assemble(("Error:", "bold red"), f" {message}"))


def fresh(folder: Path) -> Path:
    """Return the path of a new folder, so that results never mix.

    Args:
        folder: The preferred path.

    Returns:
        `folder`, or the first of folder-2, folder-3, … that does not exist.

    Raises:
        ConfigError: `folder` is a file.
    """
    if folder.is_file():
        raise ConfigError(f"{folder}: expected a folder, got a file; choose another name")

    path = folder
    number = 1
    while path.exists():
        number += 1
        path = folder.with_name(f"{folder.name}-{number}")
    return path


def print_json(document: Any) -> None:
    """Print the JSON document of a command with `--json`; stdout contains nothing else."""
    out.print(json.dumps(document, indent=2, default=str))


def progress(text: str) -> None:
    """Print a line about a step of a long task."""
    out.print(text)
