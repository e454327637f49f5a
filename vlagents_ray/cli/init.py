"""Writes skeletons of a policy, an environment, a dialect or a plug-in; each skeleton works
unchanged and passes its own tests.

The folder `skeletons/KIND/` contains the templates, in which `$name` is the name of the module and
`$title` the name of its class.
"""

from __future__ import annotations

import importlib.util
import keyword
import re
import shlex
import shutil
import sys
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated, Literal, cast

import typer
from typer.core import TyperGroup

from vlagents_ray.cli.console import errors, out
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import names

init = typer.Typer(
    no_args_is_help=True, help="Write a working skeleton, with its test, into the current folder."
)
# Kind of skeleton -> the path of each file to write, in which $name is the name of the module ->
# the file's template in skeletons/KIND.
_MODULE = {"$name.py": "module.py", "test_$name.py": "test.py", "$name.yaml": "run.yaml"}
_FILES = {
    "policy": _MODULE,
    "env": _MODULE,
    "dialect": _MODULE,
    "plugin": {
        "$name/pyproject.toml": "pyproject.toml",
        "$name/README.md": "readme",
        "$name/$name.yaml": "run.yaml",
        "$name/test_$name.py": "test",
        "$name/$name/__init__.py": "init",
        "$name/$name/registry.py": "registry",
        "$name/$name/policy.py": "policy",
        "$name/$name/latency.py": "latency",
        "$name/$name/command.py": "command",
    },
}
Kind = Literal["policy", "env", "dialect", "plugin"]
Name = Annotated[
    str, typer.Argument(metavar="NAME", help="Name of the module: lower case, such as my_policy.")
]


@init.command()
def policy(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new policy, its test, and its deployment
    file.
    """
    with errors():
        _write(name, "policy")
        command = as_typed("vlagents-ray")
        _print_steps(
            (f"{command} serve {name}.yaml", "serves it"),
            (f"{command} eval tabletop --policy {name}.yaml --out runs/{name}", "evaluates it"),
        )


@init.command("env")
def environment(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new environment, its test, and a run
    file.
    """
    with errors():
        _write(name, "env")
        command = f"{as_typed('vlagents-ray')} eval {name}.yaml"
        _print_steps((command, "runs ten episodes in the environment"))


@init.command()
def dialect(name: Name) -> None:
    """Write NAME.py, test_NAME.py and NAME.yaml: a new protocol, its test, and a deployment
    file.
    """
    with errors():
        _write(name, "dialect")
        _print_steps(
            (f"{as_typed('vlagents-ray')} serve {name}.yaml", "serves a policy that returns zeros"),
            (
                f'curl -d \'{{"q": [0, 0], "task": "lift the cup"}}\' http://localhost:8000/{name}',
                "calls the policy, in a second terminal",
            ),
        )


@init.command()
def plugin(name: Name, context: typer.Context) -> None:
    """Write the folder NAME: a package with a policy, a part of the server and a command, and
    their test.
    """
    with errors():
        commands = cast(TyperGroup, context.find_root().command)
        registered = {
            "policy": names("policies"),
            "part of a server": names("replica"),
            "command": commands.list_commands(context),
        }
        for noun, registered_names in registered.items():
            if name in registered_names:
                raise ConfigError(
                    f"NAME: {name!r} is already the name of a {noun}; choose another name"
                )
        _write(name, "plugin")
        command = as_typed("vlagents-ray")
        python = as_typed("python")
        _print_steps(
            (f"cd {name}", "the folder of the plug-in"),
            (f"{python} -m pip install --editable .", "registers the plug-in in this environment"),
            (f"{python} test_{name}.py", "runs the test; pytest does the same"),
            (f"{command} serve {name}.yaml", "serves it"),
        )


def render(name: str, kind: Kind) -> dict[Path, str]:
    """Fill the templates of a skeleton.

    Args:
        name: The name of the module.
        kind: The kind of the skeleton.

    Returns:
        The text of each file by its path, relative to the current folder.
    """
    names = {"name": name, "title": "".join(word.title() for word in name.split("_"))}
    templates = files(__package__ or "") / "skeletons" / kind
    texts = {}
    for pattern, source in _FILES[kind].items():
        template = (templates / f"{source}.template").read_text("utf-8")
        texts[Path(Template(pattern).substitute(names))] = Template(template).substitute(names)
    return texts


def _write(name: str, kind: Kind) -> None:
    """Write the files of a skeleton into the current folder; if an error occurs, write no file.

    Raises:
        ConfigError: The name is invalid, or a file or module of this name exists.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise ConfigError(
            "NAME: expected the name of a Python module in lower case, such as my_policy, got "
            f"{name!r}"
        )

    texts = render(name, kind)
    existing = [str(path) for path in texts if path.exists()]
    if existing:
        raise ConfigError(
            f"{', '.join(existing)}: already exist, so nothing was written; choose another NAME"
        )
    if importlib.util.find_spec(name) is not None:
        raise ConfigError(
            f"NAME: {name!r} is an installed module, which your module would hide; choose another "
            f"name"
        )

    created: list[Path] = []  # written files and folders, in order
    try:
        for path, text in texts.items():
            for folder in reversed(path.parents[:-1]):
                if not folder.exists():
                    folder.mkdir()
                    created.append(folder)
            with path.open("x") as file:
                created.append(path)
                file.write(text)
    except OSError:
        for path in reversed(created):
            if path.is_dir():
                path.rmdir()
            else:
                path.unlink()
        raise

    out.print(f"wrote {', '.join(map(str, texts))}. Next:")
    if kind != "plugin":
        command = f"{as_typed('python')} test_{name}.py"
        _print_steps((command, "runs the test; pytest does the same"))


def as_typed(program: str) -> str:
    """Return the command with which the user runs a program of this environment.

    Args:
        program: The name of the program.

    Returns:
        The name, if the shell finds this program under its name; otherwise the path.
    """
    path = Path(sys.executable).with_name(program)
    on_path = shutil.which(program)
    if on_path is not None and Path(on_path).absolute() == path:
        return program
    if path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return shlex.quote(str(path))


def _print_steps(*steps: tuple[str, str]) -> None:
    """Print commands to type next, each with its effect."""
    width = max(len(command) for command, _ in steps)
    for command, effect in steps:
        out.print(f"{command:<{width}}   {effect}")
