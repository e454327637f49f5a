"""Arguments of the commands that the light install has: readers for argparse, whose errors name
the cure.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from vlagents_ray.naming import did_you_mean


def number(
    kind: type[float] | type[int] = float,
    *,
    least: float = 0,
    above: bool = False,
    most: float = 1e9,
) -> Callable[[str], float]:
    """Return a function with which argparse reads a number not below `least`, or above it, and
    up to `most`.
    """

    def read(text: str) -> float:
        with contextlib.suppress(ValueError):
            value = kind(text)
            if (value > least or (value == least and not above)) and value > most:
                raise argparse.ArgumentTypeError(f"got {text!r}, want at most {most:g}")
            if value > least or (value == least and not above):
                return value
        what = "a whole number" if kind is int else "a number"
        raise argparse.ArgumentTypeError(
            f"got {text!r}, want {what} {'above' if above else 'from'} {least:g}"
        )

    return read


def one_of(*names: str) -> dict[str, Any]:
    """Return the settings of an argument that is one of `names`; unlike with `choices`, an error
    has a suggestion.
    """

    def read(text: str) -> str:
        if text not in names:
            raise argparse.ArgumentTypeError(
                f"got {text!r}, want one of {list(names)}{did_you_mean(text, names)}"
            )
        return text

    return {"type": read, "metavar": f"{{{','.join(names)}}}"}


def parse_all(
    parser: argparse.ArgumentParser,
    arguments: Sequence[str],
    cures: Mapping[str, str] = MappingProxyType({}),
) -> argparse.Namespace:
    """Parse the arguments; the process ends with status 2 and a suggestion if one of them is
    unknown.

    `cures` are those of options that users expect and that do not exist.
    """
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        names = (word.partition("=")[0] for word in unknown)
        cure = next((cures[name] for name in names if name in cures), None)
        if cure is not None:
            parser.error(cure)
        words = parser.format_help().replace(",", " ").split()
        known = [word.removeprefix("--") for word in words if word.startswith("--")]
        meant = [word.lstrip("-").partition("=")[0] for word in unknown if word.startswith("-")]
        guesses = "".join(did_you_mean(word, known) for word in meant).replace("mean '", "mean '--")
        parser.error(
            f"unrecognized arguments: {' '.join(unknown)}{guesses or '; --help lists the options'}"
        )
    return options
