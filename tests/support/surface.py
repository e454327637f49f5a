"""The public surface that users depend on, and that must not change unnoticed: names, settings,
paths, metrics, columns and options.

`python tests/support/surface.py` writes tests/surface.txt again, so that reviewers see each change.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sqlite3
import sys
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from vlagents_ray.cli.robot import command_parser

ROOT = Path(__file__).parents[2]
FILE = ROOT / "tests/surface.txt"
MODULES = (
    "vlagents_ray",
    "vlagents_ray.abilities",
    "vlagents_ray.robot",
    "vlagents_ray.robot.leaders",
    "vlagents_ray.viewers",
    "vlagents_ray.testing",
    "vlagents_ray.envs",
    "vlagents_ray.evaluate",
    "vlagents_ray.evaluate.robot",
    "vlagents_ray_learn",
    "vlagents_ray_robot.teleoperation",
    "vlagents_ray_robot.testing",
)


def surface() -> str:
    """Return the whole surface, one entry per line, in sections."""
    sections = {
        "Python: public names and their arguments": python_names(),
        "Errors: codes in answers, and their classes": error_codes(),
        "Registered names": registered(),
        "Deployment file: args": models_of("vlagents_ray.serve.config.deployment:ServerArgs"),
        "Deployment file: args.config of each policy": settings_of("policies"),
        "Deployment file: args.dialects": settings_of("dialects"),
        "Deployment file: args.parts": settings_of("replica"),
        "Evaluation file": models_of("vlagents_ray.evaluate.plan.config:EvalConfig"),
        "Evaluation file: env_options of each environment": settings_of("envs"),
        "HTTP: paths of an application": paths(),
        "Prometheus: series and their own tags": series(),
        "Exported tables: columns": columns(),
        "results.db: columns": database(),
        "Command line: vlagents-ray": commands(),
        "Command line: vlagents-ray robot": robot_options(),
        "Environment variables": variables(),
    }
    return "\n".join(
        f"# {title}\n" + "".join(f"{line}\n" for line in lines) for title, lines in sections.items()
    )


def python_names() -> Iterator[str]:
    for name in MODULES:
        module = importlib.import_module(name)
        for one in sorted(module.__all__):
            value = getattr(module, one)
            if not (inspect.isclass(value) or inspect.isfunction(value)) or hasattr(
                value, "model_fields"
            ):
                yield f"{name}.{one}"  # settings have a separate section
                continue
            yield f"{name}.{one}{_arguments(value)}"
            if inspect.isclass(value):
                yield from (f"{name}.{one}.{method}" for method in sorted(_methods(value)))


def _methods(cls: type) -> Iterator[str]:
    for name, value in vars(cls).items():
        if name.startswith("_"):
            continue
        if inspect.isfunction(value) or isinstance(value, classmethod | staticmethod):
            yield f"{name}{_arguments(value if inspect.isfunction(value) else value.__func__)}"
        elif isinstance(value, property):
            yield name


def _arguments(value: Any) -> str:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return ""
    kept = [one for one in signature.parameters.values() if one.name not in ("self", "cls")]
    if [one.name for one in kept] == ["args", "kwargs"]:  # a class without its own `__init__`
        kept = []
    return f"({', '.join(_argument(one) for one in kept)})"


def _argument(one: inspect.Parameter) -> str:
    mark = {one.VAR_POSITIONAL: "*", one.VAR_KEYWORD: "**"}.get(one.kind, "")
    only = "keyword " if one.kind is one.KEYWORD_ONLY else ""
    return f"{only}{mark}{one.name}" + (
        "" if one.default is one.empty else f"={_shown(one.default)}"
    )


def _shown(value: Any) -> str:
    """Return a default without parts that differ between runs or machines."""
    if inspect.isclass(value) or inspect.isroutine(value):
        return str(value.__qualname__)
    text = (
        re.sub(r" at 0x[0-9a-f]+", "", repr(value))
        .replace(str(Path.home()), "~")
        .replace(str(ROOT), ".")
    )
    return " ".join(text.split())


def error_codes() -> Iterator[str]:
    errors = importlib.import_module("vlagents_ray.errors")
    found = {one for one in vars(errors).values() if inspect.isclass(one) and hasattr(one, "code")}
    yield from sorted(
        f"{one.code}: {one.__name__}({', '.join(base.__name__ for base in one.__bases__)})"
        for one in found
    )


def registered() -> Iterator[str]:
    registry = importlib.import_module("vlagents_ray.registry")
    kinds = (
        "policies",
        "wrappers",
        "envs",
        "dialects",
        "robots",
        "leaders",
        "replica",
        "exports",
        "trackers",
    )
    for kind in kinds:
        yield f"{kind}: {', '.join(sorted(registry.names(kind)))}"


def settings_of(kind: str) -> Iterator[str]:
    registry = importlib.import_module("vlagents_ray.registry")
    for name, entry in sorted(registry.entries(kind).items(), key=lambda named: named[0]):
        cls = _class(entry.target)
        config = getattr(cls, "Config", None)
        if config is None:
            yield f"{name}{_arguments(cls.__init__)}"
        else:
            yield from (f"{name}.{line}" for line in _fields(config))


def models_of(place: str) -> Iterator[str]:
    yield from _fields(_class(place))


def _class(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def _fields(model: Any, before: tuple[type, ...] = ()) -> Iterator[str]:
    for attribute, field in model.model_fields.items():
        name = field.alias or attribute
        inner = [] if field.annotation in before else list(_models(field.annotation))
        if field.is_required():
            yield f"{name} (required)"
        elif (
            not inner
            or field.default is None
            or field.get_default(call_default_factory=True) in ([], {})
        ):
            yield f"{name} = {_shown(field.get_default(call_default_factory=True))}"
        for one in inner:
            if one not in before:
                yield from (f"{name}.{line}" for line in _fields(one, (*before, model)))


def _models(annotation: Any) -> Iterator[Any]:
    if inspect.isclass(annotation) and hasattr(annotation, "model_fields"):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _models(part)


def paths() -> Iterator[str]:
    http = importlib.import_module("vlagents_ray.serve.endpoints.http")
    live = importlib.import_module("vlagents_ray_live.live_page")
    weights = importlib.import_module("vlagents_ray_learn.weights_endpoint")
    watched = live.live_routes(None, open_to_network=False)
    pushed = weights.weights_routes(None, 0.0, open_to_network=False)
    engine = SimpleNamespace(stats=None)  # the routes need the engine only for requests
    app = http.build_http_app(engine, dict, None, more=[*watched, *pushed])
    for route in app.routes:
        methods = " ".join(sorted((getattr(route, "methods", None) or {"WS"}) - {"HEAD"}))
        yield f"{methods} {route.path}"


def series() -> list[str]:
    """Return the metrics from the calls that create them, since Ray's own metrics cannot be
    listed.
    """
    files = (
        *ROOT.glob("vlagents_ray/serve/**/*.py"),
        *ROOT.glob("plugins/*/vlagents_ray_*/**/*.py"),
    )
    texts = [
        text
        for text in (file.read_text() for file in files)
        if "make = partial(series, " in text or "= series(" in text
    ]
    found = []
    for call in (node for text in texts for node in ast.walk(ast.parse(text))):
        name_of_call = getattr(call.func, "id", "") if isinstance(call, ast.Call) else ""
        if name_of_call == "series":
            _, kind, name, _, *tags = call.args
        elif name_of_call == "make":  # a `partial` of `series` with the first argument
            kind, name, _, *tags = call.args
        else:
            continue
        words = [ast.literal_eval(tag) for tag in tags]
        found.append(
            f"ray_vlagents_{ast.literal_eval(name)} {ast.unparse(kind).lower()} "
            f"[{', '.join(words)}]"
        )
    return sorted(found)


def columns() -> Iterator[str]:
    tables = importlib.import_module("vlagents_ray.evaluate.exports")
    yield from (f"{one.name}: {one.type}" for one in tables.COLUMNS)


def database() -> Iterator[str]:
    connection = sqlite3.connect(":memory:")
    module = importlib.import_module("vlagents_ray.evaluate.results.database")
    yield f"version: {module.VERSION}"
    connection.executescript(module.SCHEMA)
    for (name,) in connection.execute(
        "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
    ).fetchall():
        found = connection.execute(f"PRAGMA table_info({name})").fetchall()
        yield f"{name}: {', '.join(f'{column[1]} {column[2]}' for column in found)}"


def commands() -> Iterator[str]:
    import typer

    app = importlib.import_module("vlagents_ray.cli.main").app
    yield from _commands(typer.main.get_command(app), "vlagents-ray")


def _commands(command: Any, name: str) -> Iterator[str]:
    inner = getattr(command, "commands", {})
    if not inner:
        yield name
    for one in sorted(command.params, key=lambda one: str(one.name)):
        if one.name in ("help", "install_completion", "show_completion"):
            continue
        option = one.param_type_name == "option"
        what = (
            " / ".join(sorted((*one.opts, *one.secondary_opts)))
            if option
            else str(one.name).upper()
        )
        default = "(required)" if one.required else f"= {_shown(one.default)}"
        yield f"{name} {what} {default}"
    for inside in sorted(inner):
        yield from _commands(inner[inside], f"{name} {inside}")


def robot_options() -> Iterator[str]:
    parser, _, _ = command_parser()
    for one in sorted(parser._actions, key=lambda one: one.dest):
        if one.dest != "help":
            what = " / ".join(one.option_strings) or one.dest.upper()
            yield f"{what} " + ("(required)" if one.required else f"= {_shown(one.default)}")


def variables() -> list[str]:
    found: set[str] = set()
    packages = (ROOT / "vlagents_ray", *ROOT.glob("plugins/*/vlagents_ray_*"))
    for path in (path for package in packages for path in package.rglob("*.py")):
        found |= set(re.findall(r"\"(VLAGENTS_RAY_[A-Z_]+)\"", path.read_text()))
    return sorted(found)


def lines_that_differ(before: str, after: str) -> Iterable[str]:
    """Return removed lines with - and added lines with +."""
    old, new = before.splitlines(), after.splitlines()
    return [f"- {line}" for line in old if line not in set(new)] + [
        f"+ {line}" for line in new if line not in set(old)
    ]


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        FILE.write_text(surface())
