"""Arguments of the commands in the light install: parsing with argparse, with errors that contain
the cure.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NoReturn

from vlagents_ray.cli.help_page import (
    HELP,
    VERSION,
    HelpPage,
    HelpPanel,
    HelpRow,
    default_text,
    row,
    usage_error,
    version_line,
)
from vlagents_ray.naming import did_you_mean


class CommandParser(argparse.ArgumentParser):
    """A parser whose help and errors look like those of Typer's commands.

    Each group of arguments has a title and, as its description, a note that is shown after the
    rows.
    """

    def __init__(self, command: str, description: str, examples: Sequence[str] = ()) -> None:
        """Create a parser with the options --help and --version.

        Args:
            command: The command as the user types it.
            description: The description, in paragraphs.
            examples: Command lines without "vlagents-ray".
        """
        super().__init__(prog=command, add_help=False, allow_abbrev=False)
        self._text = description
        self._examples = tuple(f"vlagents-ray {example}" for example in examples)
        self.general = self.add_argument_group("Options")
        self.general.add_argument("--version", action=_Version, nargs=0, help=VERSION)
        self.general.add_argument("-h", "--help", action="help", help=HELP)

    def help_page(self) -> HelpPage:
        """Return the help."""
        panels: list[HelpPanel] = []
        arguments = [action for action in self._actions if not action.option_strings]
        if arguments:
            rows = tuple(row(_term(action), action.help or "") for action in arguments)
            panels.append(HelpPanel("Arguments", rows))
        groups = [group for group in self._action_groups if group is not self.general]
        for group in (*groups, self.general):
            actions = [action for action in group._group_actions if action.option_strings]
            # The general options are last.
            actions.sort(key=lambda action: action.dest in ("version", "help"))
            if actions:
                rows = tuple(_option_row(action) for action in actions)
                panels.append(HelpPanel(group.title or "", rows, group.description or ""))
        return HelpPage(self.format_usage(), self._text, tuple(panels), self._examples)

    def format_usage(self) -> str:
        """Return the usage on one line."""
        words = [self.prog, "[OPTIONS]"]
        for action in self._actions:
            if not action.option_strings:
                words.append(_term(action) if action.required else f"[{_term(action)}]")
        return " ".join(words)

    def format_help(self) -> str:
        """Return the help as text."""
        return self.help_page().text()

    def error(self, message: str) -> NoReturn:
        """Print an error, and end the process with status 2."""
        self.exit(2, usage_error(self.format_usage(), self.prog, message))


class _Version(argparse.Action):
    """The option that prints the version; the version is looked up only when the option is used."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        sys.stdout.write(f"{version_line()}\n")
        parser.exit()


def _term(action: argparse.Action) -> str:
    """Return the text with which the help shows an argument."""
    metavar = str(action.metavar or action.dest.upper())
    if not action.option_strings:
        return metavar
    names = ", ".join(action.option_strings)
    return names if action.nargs == 0 else f"{names} {metavar}"


def _option_row(action: argparse.Action) -> HelpRow:
    default = "" if action.nargs == 0 else default_text(action.default)
    return row(_term(action), action.help or "", default, required=action.required)


def number(
    number_type: type[float] | type[int] = float,
    *,
    minimum: float = 0,
    above: bool = False,
    maximum: float = 1e9,
) -> Callable[[str], float]:
    """Return a function that argparse calls to read a number.

    Args:
        number_type: The type of the number.
        minimum: The smallest number.
        above: Whether `minimum` itself is excluded.
        maximum: The largest number.

    Returns:
        The function, which raises `ArgumentTypeError` for an invalid text.
    """

    def read(text: str) -> float:
        """Read the number; raise `ArgumentTypeError` if it is out of range."""
        with contextlib.suppress(ValueError):
            value = number_type(text)
            if value > minimum or (value == minimum and not above):
                if value > maximum:
                    raise argparse.ArgumentTypeError(
                        f"expected a number of at most {maximum:g}, got {text!r}"
                    )
                return value

        noun = "a whole number" if number_type is int else "a number"
        bound = "above" if above else "from"
        raise argparse.ArgumentTypeError(f"expected {noun} {bound} {minimum:g}, got {text!r}")

    return read


def one_of(*names: str) -> dict[str, Any]:
    """Return the keyword arguments of `add_argument` for an argument that is one of `names`; unlike
    with `choices`, an error contains a suggestion.
    """

    def read(text: str) -> str:
        """Read a name; raise `ArgumentTypeError` for an unknown name."""
        if text not in names:
            raise argparse.ArgumentTypeError(
                f"expected one of {list(names)}, got {text!r}{did_you_mean(text, names)}"
            )
        return text

    return {"type": read, "metavar": "|".join(names)}


def parse_all(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str],
    cures: Mapping[str, str] = MappingProxyType({}),
) -> argparse.Namespace:
    """Parse arguments; if an argument is unknown, the process ends with status 2 and a
    suggestion.

    Args:
        parser: The parser.
        arguments: The arguments.
        cures: Messages for options that users may expect but that do not exist, by option.

    Returns:
        The values of the arguments.
    """
    options, unknown = parser.parse_known_args(arguments)
    for argument in unknown:
        name = argument.partition("=")[0]
        if name in cures:
            parser.error(cures[name])
    if unknown:
        hint = _guesses(parser, unknown) or "; --help lists the options"
        parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    return options


def _guesses(parser: argparse.ArgumentParser, unknown: Sequence[str]) -> str:
    """Return the options that the user may have meant instead of unknown options."""
    words = parser.format_help().replace(",", " ").split()
    options = [word.removeprefix("--") for word in words if word.startswith("--")]
    guesses = ""
    for argument in unknown:
        if argument.startswith("-"):
            name = argument.lstrip("-").partition("=")[0]
            guesses += did_you_mean(name, options).replace("mean '", "mean '--")
    return guesses
