"""Arguments of the commands in the light install: readers for argparse, whose errors name the
cure.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from vlagents_ray.naming import did_you_mean


def number(
    number_type: type[float] | type[int] = float,
    *,
    minimum: float = 0,
    above: bool = False,
    maximum: float = 1e9,
) -> Callable[[str], float]:
    """Return a function with which argparse reads a number.

    Args:
        number_type: The type of the number.
        minimum: The smallest number.
        above: Whether `minimum` itself is excluded.
        maximum: The largest number.

    Returns:
        The function, which raises `ArgumentTypeError` for another text.
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
    """Return the settings for `add_argument` of an argument that is one of `names`; unlike with
    `choices`, an error has a suggestion.
    """

    def read(text: str) -> str:
        """Read a name; raise `ArgumentTypeError` for an unknown one."""
        if text not in names:
            raise argparse.ArgumentTypeError(
                f"expected one of {list(names)}, got {text!r}{did_you_mean(text, names)}"
            )
        return text

    return {"type": read, "metavar": f"{{{','.join(names)}}}"}


def parse_all(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str],
    cures: Mapping[str, str] = MappingProxyType({}),
) -> argparse.Namespace:
    """Parse arguments; the process ends with status 2 and a suggestion if one of them is unknown.

    Args:
        parser: The parser.
        arguments: The arguments.
        cures: The messages for options that users expect and that do not exist, by option.

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
    """Return the options that the user may have meant by unknown ones."""
    words = parser.format_help().replace(",", " ").split()
    options = [word.removeprefix("--") for word in words if word.startswith("--")]
    guesses = ""
    for argument in unknown:
        if argument.startswith("-"):
            name = argument.lstrip("-").partition("=")[0]
            guesses += did_you_mean(name, options).replace("mean '", "mean '--")
    return guesses
