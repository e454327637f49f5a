"""`vlagents-ray keys`: creates, lists and revokes the API keys of a server."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from vlagents_ray.cli.console import err, errors, out, table
from vlagents_ray.cli.options import finite
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.access.variables import FILE_VARIABLE

if TYPE_CHECKING:
    from vlagents_ray.serve.access.key_store import Key

keys = typer.Typer(no_args_is_help=True, help="Create, list and revoke the API keys of a server.")
File = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        metavar="FILE",
        help=f"The key file; default: {FILE_VARIABLE}, or keys.json in this folder.",
    ),
]
Name = Annotated[
    str,
    typer.Argument(
        metavar="NAME", help="Name of the robot or program that uses the key, such as arm-1."
    ),
]


@keys.command("create")
def create(
    name: Name,
    file: File = None,
    app: Annotated[
        list[str],
        typer.Option(
            metavar="NAME",
            help="An application for which the key is valid. May be repeated; default: all.",
        ),
    ] = [],  # noqa: B006
    rate: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1e6,
            callback=finite,
            metavar="N",
            help="Largest number of requests per second at each replica.",
        ),
    ] = None,
    sessions: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1_000_000,
            metavar="N",
            help="Largest number of sessions at the same time at each replica.",
        ),
    ] = None,
    priority: Annotated[
        str | None,
        typer.Option(
            metavar="robot|simulation",
            help="Highest priority of the key's requests. Robots are served before simulations; "
            "default: robot.",
        ),
    ] = None,
    scope: Annotated[
        list[str],
        typer.Option(
            metavar="weights|watch|operate",
            help="A further permission: to push weights, to see all sessions, or to send commands "
            "to them. May be repeated.",
        ),
    ] = [],  # noqa: B006
    days: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=36_500,
            callback=finite,
            metavar="N",
            help="Number of days after which the key expires.",
        ),
    ] = None,
) -> None:
    """Create a key, and print it. It is not shown again, as the file contains only its hash."""
    from vlagents_ray.serve.access.key_store import new_key

    with errors():
        expires = None if days is None else time.time() + days * 86_400
        path = _path(file)
        allowed = {
            "apps": tuple(app),
            "rate": rate,
            "sessions": sessions,
            "priority": priority,
            "scopes": tuple(scope),
        }
        token = new_key(path, name, expires=expires, **allowed)

        err.print(f"key {name} added to {path}; it is not shown again:")
        out.print(token)


@keys.command("list")
def list_(file: File = None) -> None:
    """List the keys with their permissions and limits."""
    from vlagents_ray.serve.access.key_store import read_keys

    with errors():
        listed = table("name", "for", "requests/s", "sessions", "priority", "may also", "state")
        for key in read_keys(_existing(file)):
            listed.add_row(
                key.name,
                ", ".join(key.apps) or "all",
                "any" if key.rate is None else f"{key.rate:g}",
                "any" if key.sessions is None else f"{key.sessions:g}",
                key.priority or "any",
                ", ".join(key.scopes),
                _state(key),
            )
        out.print(listed)


@keys.command("revoke")
def revoke_(name: Name, file: File = None) -> None:
    """Revoke a key. Running servers reject it within seconds, and close the connections that use
    it.
    """
    from vlagents_ray.serve.access.key_store import revoke

    with errors():
        revoke(_existing(file), name)
        out.print(f"key {name} revoked")


def _state(key: Key) -> Text:
    """Return a text that describes whether a key is valid, and until when."""
    if key.revoked:
        return Text("revoked", "red")
    if key.expires is None:
        return Text("valid", "green")
    date = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(key.expires))
    if key.expires <= time.time():
        return Text(f"expired {date}", "red")
    return Text(f"until {date}", "green")


def _path(file: Path | None) -> Path:
    """Return the path of the key file; raise `ConfigError` if it is a folder."""
    path = file or Path(os.environ.get(FILE_VARIABLE) or "keys.json")
    if path.is_dir():
        raise ConfigError(
            f"--keys: expected a key file, got the folder {path}; add its name, as "
            f"{path / 'keys.json'}"
        )
    return path


def _existing(file: Path | None) -> Path:
    """Return the path of the key file; raise `ConfigError` if it does not exist."""
    path = _path(file)
    if not path.is_file():
        raise ConfigError(
            f"keys file {path} does not exist; `vlagents-ray keys create NAME --keys {path}` "
            "creates it"
        )
    return path
