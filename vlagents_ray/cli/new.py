"""Skeletons of a policy, an environment and a dialect, which work at once and pass their own tests.

`skeletons/KIND/` has their templates, in which `$name` is the module's name and `$title` that of its class.
"""

from __future__ import annotations

import importlib.util
import keyword
import re
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated, Literal

import typer

from vlagents_ray.cli.console import errors, out
from vlagents_ray.errors import ConfigError

new = typer.Typer(no_args_is_help=True, help="Write a working skeleton, with its test, into the current folder.")
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the module: lower case, such as my_policy.")]


@new.command()
def policy(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new policy, its test, and its deployment file."""
    with errors():
        _write(name, "policy")
        out.print(f"vlagents-ray serve {name}.yaml                    serves it")
        out.print(f"vlagents-ray eval tabletop --policy {name}.yaml   evaluates it")


@new.command("env")
def environment(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new environment, its test, and a file of runs."""
    with errors():
        _write(name, "env")
        out.print(f"vlagents-ray eval {name}.yaml   plays ten episodes in it")


@new.command()
def dialect(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new protocol, its test, and a deployment file."""
    with errors():
        _write(name, "dialect")
        out.print(f"vlagents-ray serve {name}.yaml   serves a policy that does nothing; then, in a second terminal:")
        out.print(f'curl -d \'{{"q": [0, 0], "task": "lift the cup"}}\' http://localhost:8000/{name}')


def _write(name: str, kind: Literal["policy", "env", "dialect"]) -> None:
    """Write the files into the current folder, or none of them. Raises `ConfigError` for an invalid name."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(f"NAME: got {name!r}, want the name of a Python module in lower case, such as my_policy")
    names = {"name": name, "title": "".join(word.title() for word in name.split("_"))}
    templates = files(__package__ or "") / "skeletons" / kind
    sources = {f"{name}.py": "module.py", f"test_{name}.py": "test.py", f"{name}.yaml": "run.yaml"}
    texts = {
        Path(path): Template((templates / f"{source}.template").read_text("utf-8")).substitute(names)
        for path, source in sources.items()
    }
    if there := [str(path) for path in texts if path.exists()]:
        raise ConfigError(f"{', '.join(there)}: there already, and nothing was written; choose another NAME")
    if importlib.util.find_spec(name) is not None:
        raise ConfigError(f"NAME: {name!r} is a module that is installed, and yours would hide it; choose another one")
    for path, text in texts.items():
        with path.open("x") as file:
            file.write(text)
    out.print(f"wrote {', '.join(map(str, texts))}. Next, in this folder:")
    out.print(f"pytest test_{name}.py   checks it")
