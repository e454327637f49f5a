"""The command `vlagents-ray homing`."""

import json
import urllib.request

import typer


def latency(url: str = typer.Argument(help="The server, http://localhost:8000.")) -> None:
    """Print how many calls a server's policy has answered, and how long they took, ms."""
    with urllib.request.urlopen(f"{url}/homing/latency", timeout=10) as answer:
        typer.echo(json.dumps(json.load(answer)))
