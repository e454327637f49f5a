"""The command `vlagents-ray homing`."""

import json
import urllib.error
import urllib.request

import typer


def latency(url: str = typer.Argument(help="The server, http://localhost:8000.")) -> None:
    """Print how many calls a server's policy has answered, and how long they took, ms."""
    try:
        with urllib.request.urlopen(f"{url}/homing/latency", timeout=10) as answer:
            typer.echo(json.dumps(json.load(answer)))
    except urllib.error.URLError as error:
        message = f"{url}: expected a server with the part homing, got {error}; start one"
        typer.echo(message, err=True)
        raise typer.Exit(1) from error
