"""Distinct names for files and in JSON objects, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

T = TypeVar("T")


def plain(name: str) -> str:
    """Return `name` as a part of a file's name: "maniskill/PushCube-v1" ->
    "maniskill_PushCube-v1"; "pi0@20" stays.
    """
    return re.sub(r"[^\w.@-]+", "_", name)


def distinct(names: Iterable[str], simplify: Callable[[str], str] = plain) -> dict[str, str]:
    """Simplify names, and append numbers if two of them would become the same, whatever their
    order.

    "left/wrist" becomes "left_wrist"; beside a "left_wrist", which keeps its name, it becomes
    "left_wrist_2".
    """
    wanted = sorted(set(names), key=lambda name: (simplify(name) != name, name))
    found: dict[str, str] = {}
    for name in wanted:
        own, number = simplify(name), 1
        while own in found.values():
            number += 1
            own = f"{simplify(name)}_{number}"
        found[name] = own
    return found


def did_you_mean(got: str, known: Iterable[str]) -> str:
    """Suggest a known name as the end of a message, "; did you mean 'scripted'?"; "" if none is
    similar to `got`.
    """
    by_lower = {name.lower(): name for name in known}
    close = difflib.get_close_matches(got.lower(), by_lower, n=1)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise `ValueError` if a key occurs twice, since either value could
    be meant.
    """
    found = dict(pairs)
    if len(found) < len(pairs):
        # In linear time, as the keys are a stranger's.
        [(twice, _)] = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:80]!r} stands twice in one object")
    return found


def says_its_fields(hint: str = "") -> Callable[[type[T]], type[T]]:
    """Decorate a dataclass to list its fields in the error for an unknown one; `hint` says where
    other settings are.
    """

    def decorate(cls: type[T]) -> type[T]:
        made = cls.__init__

        @functools.wraps(made)
        def init(self: T, *args: Any, **kwargs: Any) -> None:
            try:
                made(self, *args, **kwargs)
            except TypeError as error:
                fields: list[str] = list(cls.__dataclass_fields__)  # type: ignore[attr-defined]
                if not (unknown := [name for name in kwargs if name not in fields]):
                    raise
                meant = "".join(did_you_mean(name, fields) for name in unknown)
                raise TypeError(
                    f"{cls.__name__}: got {unknown}, want some of {fields}{meant or hint}"
                ) from error

        cls.__init__ = init  # type: ignore[method-assign, assignment]
        return cls

    return decorate
