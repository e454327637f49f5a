"""The packages of a Python environment, as pins that pip reads, and their comparison with those here."""

from __future__ import annotations

import functools
import re
from importlib.metadata import distributions

_PIN = re.compile(r"([A-Za-z0-9][\w.-]{0,100})==([\w.+!-]{1,100})")


@functools.cache
def pins() -> str:
    """The packages of this environment at the first call, a line each: `numpy==2.4.6`.

    One that was not installed from an index, such as a checkout, has a comment instead of its path or URL.
    """
    lines: dict[str, str] = {}
    for one in distributions():
        metadata = one.metadata  # parsed at each access
        name = _canonical(str(metadata["Name"]))
        elsewhere = "  # not from an index" if one.read_text("direct_url.json") is not None else ""
        lines.setdefault(name, f"{name}=={metadata['Version']}{elsewhere}")
    return "".join(f"{lines[name]}\n" for name in sorted(lines))


def versions_of(text: str) -> dict[str, str]:
    """The versions of packages by name, from the text of `pins`; other lines are skipped."""
    found = (_PIN.match(line) for line in text.splitlines())
    return {_canonical(one[1]): one[2] for one in found if one is not None}


def compared(there: dict[str, str], here: dict[str, str]) -> tuple[int, list[str]]:
    """Compare two environments.

    Args:
        there: Versions by the names of packages.
        here: The same of this environment.

    Returns:
        The number of packages that are the same, and the others of `there`, a phrase each.
    """
    same = sum(here.get(name) == version for name, version in there.items())
    odd = [
        f"{name} {version} there, {here.get(name, 'none')} here"
        for name, version in there.items()
        if here.get(name) != version
    ]
    return same, odd


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
