"""The reference of commands and settings, as Markdown for the pages in docs/reference.

The text comes from the parsers of the commands and from the models of the settings, so it always
matches the code.
"""

from __future__ import annotations

import importlib
import inspect
import re
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from typer.main import get_command

from vlagents_ray.cli.arguments import CommandParser
from vlagents_ray.cli.help_page import HelpPage, HelpPanel, paragraphs
from vlagents_ray.cli.main import app
from vlagents_ray.cli.robot import command_parser as robot_parser
from vlagents_ray.cli.typer_help import commands_of, page_of_command
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.policies.base.config import ModelConfig
from vlagents_ray.registry import CORE, RegistryEntry, entries
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.config.dialects import DialectArgs, DialectConfig, KeylessPortConfig
from vlagents_ray.serve.config.parts import PartArgs, PartConfig
from vlagents_ray.serve.config.registered import RegisteredArgs
from vlagents_ray_robot.check_command import command_parser as check_parser

ROOT = Path(__file__).parents[2]
# Keys that the model requires, but for which the command has a default.
_DEFAULTS_OF_COMMANDS = {"out": "`runs/NAME`"}
# Pages that explain a setting, by "Model.field".
SEE = {
    "EvalConfig.workers": "evaluation/running.md#in-one-process",
    "EvalConfig.accept_changes": "evaluation/running.md#changed-code-and-weights",
    "EvalConfig.stop": "evaluation/running.md#early-stopping",
    "EvalConfig.track": "evaluation/results.md#trackers",
    "EvalConfig.robot": "evaluation/robot.md",
    "EvalConfig.record": "evaluation/results.md",
    "EvalConfig.video": "evaluation/speed.md#what-is-rendered",
    "PolicyConfig.steps": "evaluation/running.md#sweeps",
    "PolicyConfig.pushed_weights": "weights.md#which-weights-acted",
    "RobotConfig.arm": "arms.md",
    "RobotConfig.mode": "control_loop.md",
    "RobotConfig.limits": "guard.md#limits-of-motion",
    "RobotConfig.ignore_mismatch": "guard.md#does-this-checkpoint-fit-this-arm",
    "SuiteConfig.clock": "evaluation/real_time.md",
    "WorkerConfig.gpus": "cluster/scaling.md#gpus-for-rendering",
    "ServerArgs.policy": "policies/index.md",
    "ServerArgs.config": "reference/policies.md",
    "ServerArgs.autoscaling": "cluster/scaling.md",
    "ServerArgs.batch": "serving.md#batches",
    "ServerArgs.access": "keys.md",
    "ServerArgs.environment": "python_environments.md",
    "ServerArgs.dialects": "other_clients.md",
    "ServerArgs.parts": "plugins.md",
    "ServerArgs.wrappers": "policies/index.md",
}


def folder_of(entry: RegistryEntry) -> str:
    """Return the folder in the checkout of the distribution that registers an entry."""
    return "." if entry.distribution == CORE else f"plugins/{entry.distribution.replace('-', '_')}"


def own_entries(kind: str) -> dict[str, RegistryEntry]:
    """Return the entries of this repository. Plug-ins from elsewhere, which may also be installed,
    have no pages here.
    """
    return {
        name: entry for name, entry in entries(kind).items() if (ROOT / folder_of(entry)).is_dir()
    }


def help_pages() -> dict[str, HelpPage]:
    """Return the help of each command; the keys are the words that a user types."""
    others = {
        f"vlagents-ray {name}" for name in entries("commands").keys() - own_entries("commands")
    }
    found: dict[str, HelpPage] = {}
    for path, command in commands_of(get_command(app)):
        if " ".join(path.split()[:2]) in others:
            continue
        if path == "vlagents-ray robot":
            parser, _, _ = robot_parser()
            if not isinstance(parser, CommandParser):
                raise TypeError(f"expected a CommandParser, got a {type(parser).__name__}")
            # The names of plug-ins depend on the installed packages.
            found[path] = CommandParser.help_page(parser)
            found[f"{path} check"] = check_parser().help_page()
        else:
            found[path] = page_of_command(command, path)
    return found


def _title(page: str) -> str:
    """Return the title of a page, whose path is relative to docs/."""
    lines = (ROOT / "docs" / page).read_text().splitlines()
    return next(line.removeprefix("# ") for line in lines if line.startswith("# "))


def commands() -> str:
    """Return a table of the commands, and a section for each with its options."""
    found = help_pages()
    main = found.pop("vlagents-ray")
    rows = []
    for panel in main.panels:
        if panel.title != "Options":
            for row in panel.rows:
                if f"vlagents-ray {row.term}" in found:
                    link = f"[`{row.term}`](#vlagents-ray-{row.term})"
                    rows.append(f"| {link} | {_cell(row.about)} |")
    parts = ["\n".join(["| command | purpose |", "|---|---|", *rows]) + "\n"]
    for path, page in found.items():
        parts.append(_command(path, page))
    return "\n".join(parts)


def _command(path: str, page: HelpPage) -> str:
    """Return the section of a command."""
    lines = [f"## `{path}`", ""]
    for paragraph in paragraphs(page.description):
        lines += [_prose(paragraph), ""]
    lines += ["```text", page.usage, "```", ""]
    for panel in page.panels:
        rows = [row for row in panel.rows if row.term not in ("-h, --help", "--version")]
        if rows:
            lines += [*_panel(panel, rows), ""]
    if page.examples:
        lines += ["```text", *page.examples, "```", ""]
    return "\n".join(lines)


def _panel(panel: HelpPanel, rows: Iterable[Any]) -> Iterator[str]:
    """Yield the table of a group of options."""
    yield f"**{panel.title}**"
    yield ""
    yield (
        "| option | meaning | default |"
        if panel.title != "Arguments"
        else ("| argument | meaning | default |")
    )
    yield "|---|---|---|"
    for row in rows:
        default = "required" if row.required else _code(row.default)
        yield f"| {_term(row.term)} | {_cell(row.about)} | {default} |"
    if panel.note:
        yield ""
        yield _prose(panel.note)


def _term(term: str) -> str:
    """Return an option and its value. Alternatives of a value are a list, since `|` would end a
    cell of the table.
    """
    names, space, metavar = term.rpartition(" ") if term.startswith("-") else ("", "", term)
    if "|" not in term:
        return f"`{term}`"
    if not names:
        return ", ".join(f"`{word.strip()}`" for word in term.split("|"))
    return f"`{names}`{space}" + ", ".join(f"`{choice}`" for choice in metavar.split("|"))


def _code(default: str) -> str:
    """Return a default as code if it is a value, or as plain words."""
    return f"`{default}`" if re.fullmatch(r"[\w./:-]+", default) else _cell(default)


def _prose(text: str) -> str:
    """Return a text of the command line as Markdown, with links to the pages that it names."""
    parts = re.split(r"(`[^`]*`)", text)
    for number in range(0, len(parts), 2):
        part = _escaped(parts[number])
        part = re.sub(r"(?<![\w-])(--[a-z][\w-]*)", r"`\1`", part)
        parts[number] = re.sub(r"docs/([\w\\/]+)\.md", _link_of_page, part)
    return "".join(parts)


def _escaped(text: str) -> str:
    """Escape Markdown characters in a text outside code."""
    return text.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")


def _link_of_page(match: re.Match[str]) -> str:
    name = match[1].replace("\\", "")
    return f"[{name.replace('_', ' ')}](../{name}.md)"


def _cell(text: str) -> str:
    return _prose(text).replace("|", "\\|")


def run_file() -> str:
    """Return the sections of the run file, each with its keys."""
    return "\n".join(_models(EvalConfig, ""))


def deployment_file() -> str:
    """Return the sections below `args` of a deployment file, each with its keys."""
    parts = [
        *_models(ServerArgs, "args"),
        *_registered(DialectArgs, DialectConfig, "args.dialects"),
        *_registered(PartArgs, PartConfig, "args.parts"),
    ]
    return "\n".join(parts)


def policy_settings() -> str:
    """Return the settings of each policy and wrapper."""
    configs: dict[tuple[str, str], type[BaseModel]] = {}
    for kind in ("policies", "wrappers"):
        for name, entry in sorted(own_entries(kind).items()):
            config = getattr(_target(entry.target), "Config", None)
            if config is not None:
                configs[kind, name] = config
    common = ModelConfig.model_fields
    parts = ["## Common settings\n"]
    parts.append(
        "All policies of model families have these settings. A default that differs is in the "
        "policy's table.\n"
    )
    parts.append(_table("ModelConfig", common, ModelConfig))
    for (kind, name), config in configs.items():
        noun = "policy" if kind == "policies" else "wrapper"
        own = {}
        for key, field in config.model_fields.items():
            shared = common.get(key)
            if shared is None or repr(shared.default) != repr(field.default):
                own[key] = field
        parts.append(f"## `{name}`: {noun}\n")
        has_common = common.keys() <= config.model_fields.keys()
        if has_common:
            parts.append("It also has the [common settings](#common-settings).\n")
        parts.append(_table(config.__name__, own, config))
    return "\n".join(parts)


def _target(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def _models(model: type[BaseModel], prefix: str) -> Iterator[str]:
    """Yield the sections of a model and of the models in its fields, each once."""
    paths = dict(sections(model, prefix))
    anchors = {found: path.replace(".", "") for found, path in paths.items()}
    for found, path in paths.items():
        yield _section(found, path, anchors)


def sections(model: type[BaseModel], prefix: str) -> list[tuple[type[BaseModel], str]]:
    """Return a model and the models in its fields, each once, with the path of its key.

    Args:
        model: The model.
        prefix: The path of the model itself.
    """
    waiting = [(model, prefix)]
    paths: dict[type[BaseModel], str] = {}
    while waiting:
        current, path = waiting.pop(0)
        if current in paths:
            continue
        paths[current] = path
        for name, field in current.model_fields.items():
            for inner in _inner_models(field.annotation):
                waiting.append((inner, f"{path}.{name}".lstrip(".")))
    return list(paths.items())


def _section(model: type[BaseModel], path: str, anchors: dict[type[BaseModel], str]) -> str:
    """Return the section of a model."""
    title = f"## `{path}`" if path else "## Top level"
    about = " ".join((model.__doc__ or "").split("\n\n")[0].split())
    table = _table(model.__name__, model.model_fields, model, anchors)
    return "\n".join([title, "", _plain(about), "", table])


def _plain(about: str) -> str:
    """Return a docstring without references to modules."""
    return re.sub(r",? \(?see `[\w.]+`\)?", "", about)


def _registered(section: type[RegisteredArgs], base: type[BaseModel], path: str) -> Iterator[str]:
    """Yield the sections of dialects or parts."""
    described: set[type[BaseModel]] = set()
    common = {**base.model_fields}
    if section is DialectArgs:
        common |= KeylessPortConfig.model_fields
        yield f"## `{path}`\n"
        yield (
            "A key for each dialect that is on. Dialects have these settings, and `port`, `host` "
            "and `without_key` if their section has\na `port`.\n"
        )
        yield _table("", common, KeylessPortConfig)
    for name, entry in sorted(own_entries(section.kind).items()):
        config = section.config_of(name)
        own = {}
        for key, field in config.model_fields.items():
            if key not in common or repr(common[key].default) != repr(field.default):
                own[key] = field
        if own:
            table = _table(config.__name__, own, config)
        else:
            table = "It has no settings of its own: `{}`.\n"
        about = _sentence(entry.about) + "\n" if entry.about else ""
        yield "\n".join(filter(None, [f"## `{path}.{name}`\n", about, table]))
        for key, field in own.items():
            for inner in _inner_models(field.annotation):
                if inner not in described:
                    described.add(inner)
                    yield f"### `{path}.{name}.{key}`\n"
                    yield _table(inner.__name__, inner.model_fields, inner)


def _table(
    model: str,
    fields: dict[str, FieldInfo],
    owner: type[BaseModel] | None = None,
    anchors: dict[type[BaseModel], str] | None = None,
) -> str:
    """Return the table of the fields of a model.

    Args:
        model: The name of the model.
        fields: The fields by attribute.
        owner: The model, whose base classes may describe a field.
        anchors: The anchors of the sections of other models.
    """
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    for attribute, field in fields.items():
        name = field.alias or attribute
        meaning = _sentence(_description(field, attribute, owner))
        if field.default is None:
            meaning = re.sub(r"; (?:unset|default): ", ". null: ", meaning)
        see = SEE.get(f"{model}.{name}")
        if see:
            link = f"../{see}".replace("../reference/", "")
            meaning += f" See [{_title(see.partition('#')[0])}]({link})."
        kind = _type(field.annotation)
        for inner in _inner_models(field.annotation):
            if inner in (anchors or {}):
                kind = kind.replace("mapping", f"[mapping](#{(anchors or {})[inner]})")
        lines.append(f"| `{name}` | {kind} | {_default(name, field)} | {meaning.strip()} |")
    return "\n".join(lines) + "\n"


def _description(field: FieldInfo, name: str, owner: type[BaseModel] | None) -> str:
    """Return the description of a field, or the description of the base class's field."""
    if field.description or owner is None:
        return field.description or ""
    for base in owner.__mro__[1:]:
        inherited = getattr(base, "model_fields", {}).get(name)
        if inherited is not None and inherited.description:
            return str(inherited.description)
    return ""


def _sentence(text: str) -> str:
    """Return a description as a sentence in a cell of a table."""
    text = " ".join(text.split())
    if not text:
        return ""
    if re.match(r"[a-z]+\b(?![_:.(])", text):
        text = text[0].upper() + text[1:]
    if text[-1] not in ".!?":
        text += "."
    parts = re.split(r"(`[^`]*`)", text)
    for number in range(0, len(parts), 2):
        parts[number] = _escaped(parts[number])
    return "".join(parts).replace("|", "\\|")


def _inner_models(annotation: Any) -> Iterator[type[BaseModel]]:
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        if not issubclass(annotation, RegisteredArgs):
            yield annotation
        return
    for part in get_args(annotation):
        yield from _inner_models(part)


_WORDS = {
    str: "text",
    int: "whole number",
    float: "number",
    bool: "true or false",
    Path: "path",
    dict: "mapping",
    list: "list",
    type(None): "null",
}


def _type(annotation: Any) -> str:
    """Return a type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(parts[0])
    if origin is Literal:
        return ", ".join(f"`{part}`" for part in parts)
    if origin in (Union, types.UnionType):
        words = dict.fromkeys(_type(part) for part in parts if part is not type(None))
        return " or ".join(words)
    if origin in (list, tuple):
        items = dict.fromkeys(_type(part) for part in parts if part is not Ellipsis)
        return f"list of {' or '.join(items)}" if items else "list"
    if origin is dict:
        return "mapping"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return "mapping"
    return _WORDS.get(annotation, "value")


def _default(name: str, field: FieldInfo) -> str:
    """Return the default of a field as YAML; nested sections have separate tables."""
    if field.is_required():
        return _DEFAULTS_OF_COMMANDS.get(name, "required")
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined or isinstance(value, BaseModel):
        return ""
    if name.endswith("_bytes") and value % (1 << 20) == 0:
        return f"`{value}` ({value >> 20} MiB)"
    if isinstance(value, tuple):
        value = list(value)
    if isinstance(value, str):
        return f'`"{value}"`' if not value else f"`{value}`"
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000).strip()
    return f"`{text.removesuffix('...').strip()}`"
