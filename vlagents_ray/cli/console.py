"""What all commands print on, and how errors look there."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from vlagents_ray.errors import ConfigError, VLAgentsError

out = Console()
err = Console(stderr=True)


@contextlib.contextmanager
def errors() -> Iterator[None]:
    """Errors of this package as one message on stderr: exit code 1, 2 for wrong settings, 130 for Ctrl-C.

    SIGTERM is treated as Ctrl-C, so that what was started is taken down in order.
    """
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except ValidationError as error:
        lines = [f"- {'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()]
        fail("wrong settings:\n" + "\n".join(lines), 2)
    except ConfigError as error:
        fail(str(error), 2)
    except VLAgentsError as error:
        fail(f"{type(error).__name__}: {error}", 1)
    except KeyboardInterrupt as error:
        fail(str(error) or "interrupted", 130)
    finally:
        signal.signal(signal.SIGTERM, before)


def fail(message: str, code: int) -> NoReturn:
    """Say what went wrong, and end with that exit code."""
    sys.stdout.flush()
    err.print(f"[bold red]error[/] {escape(message)}", highlight=False, soft_wrap=True)
    raise typer.Exit(code)


def fresh(folder: Path) -> Path:
    """`folder`, or the first of folder-2, folder-3, … that does not exist: nothing mixes with what is older."""
    candidate, number = folder, 1
    while candidate.exists():
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    return candidate


def tell(text: str) -> None:
    """A line of progress, as it is."""
    out.print(text, highlight=False, markup=False)


def save(found: Any, file: Path | None) -> None:
    """Write figures as JSON, if a file was asked for."""
    if file is not None:
        file.write_text(json.dumps(found, indent=1) + "\n")
