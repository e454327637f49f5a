"""The help of Typer's commands in the layout of `help_page`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from vlagents_ray.cli.examples import PROMPT
from vlagents_ray.cli.help_page import (
    HELP,
    HelpPage,
    HelpPanel,
    HelpRow,
    default_text,
    paragraphs,
    row,
)

_OPTIONS, _COMMANDS = "Options", "Commands"


def page_of_command(command: Any, path: str) -> HelpPage:
    """Return the help of a command.

    Args:
        command: A command that Typer has made from a function, or a group of commands.
        path: The command as the user types it, such as "vlagents-ray eval".
    """
    panels: dict[str, list[HelpRow]] = {}
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    if arguments:
        panels["Arguments"] = [_argument_row(argument) for argument in arguments]

    for param in command.params:
        if param.param_type_name == "option" and param.name != "help" and not param.hidden:
            title = getattr(param, "rich_help_panel", None) or _OPTIONS
            panels.setdefault(title, []).append(_option_row(param))
    general = panels.pop(_OPTIONS, [])
    names_of_help = (command.context_settings or {}).get("help_option_names") or ["-h", "--help"]
    panels[_OPTIONS] = [*general, HelpRow(", ".join(sorted(names_of_help, key=len)), HELP)]

    for name, inner in getattr(command, "commands", {}).items():
        title = getattr(inner, "rich_help_panel", None) or _COMMANDS
        about = inner.short_help or (paragraphs(inner.help or "") or [""])[0]
        panels.setdefault(title, []).append(HelpRow(name, about))

    examples = [
        line.removeprefix(PROMPT).strip()
        for line in (command.epilog or "").splitlines()
        if line.startswith(PROMPT)
    ]
    return HelpPage(
        " ".join([path, *usage_pieces(command)]),
        command.help or "",
        tuple(HelpPanel(title, tuple(rows)) for title, rows in panels.items()),
        tuple(examples),
    )


def usage_pieces(command: Any) -> list[str]:
    """Return the words that follow the name of a command in its usage."""
    pieces = [command.options_metavar or "[OPTIONS]"]
    pieces += [_argument_term(param) for param in command.params if _is_argument(param)]
    if getattr(command, "commands", None):
        pieces.append("COMMAND ...")
    return pieces


def _is_argument(param: Any) -> bool:
    """Return whether a parameter of a command is an argument, not an option."""
    return bool(param.param_type_name == "argument")


def _argument_term(argument: Any) -> str:
    """Return the text with which the usage shows an argument."""
    metavar = (argument.metavar or str(argument.name).upper()).strip("[]")
    if argument.nargs == -1 and not metavar.endswith("..."):
        metavar += "..."
    return metavar if argument.required else f"[{metavar}]"


def _argument_row(argument: Any) -> HelpRow:
    term = _argument_term(argument).strip("[]")
    return row(term, argument.help or "", default_text(argument.default))


def _option_row(option: Any) -> HelpRow:
    names = sorted([*option.opts, *option.secondary_opts], key=len)
    term = ", ".join(names)
    if not option.is_flag:
        term += f" {_metavar(option)}"
    return row(term, option.help or "", default_text(option.default), required=option.required)


def _metavar(option: Any) -> str:
    """Return the placeholder of an option's value."""
    if option.metavar:
        return str(option.metavar)
    return str(max(option.opts, key=len)).lstrip("-").replace("-", "_").upper()


class _WithHelpPage:
    """The methods of a command or a group that Typer calls to write help and errors."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help."""
        formatter.write(page_of_command(self, ctx.command_path).text())

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the words of the usage, for errors."""
        del ctx
        return usage_pieces(self)


class HelpCommand(_WithHelpPage, TyperCommand):
    """A command whose help is a `HelpPage`."""


class HelpGroup(_WithHelpPage, TyperGroup):
    """A group of commands whose help is a `HelpPage`."""


def commands_of(command: Any, path: str = "vlagents-ray") -> Iterator[tuple[str, Any]]:
    """Yield a command and all its subcommands, each with the words that the user types.

    Args:
        command: The command or group.
        path: The words that the user types for it.
    """
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands_of(inner, f"{path} {name}")


def use_help_pages(group: typer.Typer) -> None:
    """Make a Typer group and all commands and groups in it show their help as a `HelpPage`."""
    for command in group.registered_commands:
        if command.cls in (None, TyperCommand):
            command.cls = HelpCommand
    for subgroup in group.registered_groups:
        if subgroup.typer_instance is not None:
            subgroup.typer_instance.info.cls = HelpGroup
            use_help_pages(subgroup.typer_instance)
