"""Distinct names of files and of keys in JSON objects, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

T = TypeVar("T")


def plain(name: str) -> str:
    """Return `name` in a form that is valid in a file's name: "maniskill/PushCube-v1" ->
    "maniskill_PushCube-v1"; "pi0@20" is unchanged.
    """
    return re.sub(r"[^\w.@-]+", "_", name)


def distinct(names: Iterable[str], simplify: Callable[[str], str] = plain) -> dict[str, str]:
    """Simplify names with `plain`, and append numbers to names that would become equal,
    independently of their order.

    "left/wrist" becomes "left_wrist", or "left_wrist_2" if another name is "left_wrist", which is
    not changed.
    """
    # Names that simplification does not change come first, so that they are kept.
    in_order = sorted(set(names), key=lambda name: (simplify(name) != name, name))

    simplified: dict[str, str] = {}
    for name in in_order:
        candidate, number = simplify(name), 1
        while candidate in simplified.values():
            number += 1
            candidate = f"{simplify(name)}_{number}"
        simplified[name] = candidate
    return simplified


def did_you_mean(name: str, known: Iterable[str], similarity: float = 0.6) -> str:
    """Return a suggestion for the end of a message, such as "; did you mean 'scripted'?"; "" if no
    known name is similar to `name`.

    Args:
        name: The name that is unknown.
        known: The names that exist.
        similarity: Smallest similarity of a suggested name, from 0 to 1 for an equal name, as in
            `difflib.SequenceMatcher.ratio`.
    """
    by_lower = {known_name.lower(): known_name for known_name in known}
    close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=similarity)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""


def without_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object; raise `ValueError` if a key occurs twice, since either value could
    be meant.
    """
    values = dict(pairs)
    if len(values) < len(pairs):
        # The search takes linear time even if an attacker has chosen the keys.
        [(repeated_key, _)] = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {repeated_key[:80]!r} occurs twice in one object")
    return values


def explain_unknown_fields(hint: str = "") -> Callable[[type[T]], type[T]]:
    """Return a decorator for dataclasses, which lists the known fields in the error for an unknown
    field.

    Args:
        hint: The end of that message if no known field is similar, such as a pointer to other
            settings.
    """

    def decorate(cls: type[T]) -> type[T]:
        """Replace the constructor of `cls`."""
        original_init = cls.__init__

        @functools.wraps(original_init)
        def init(self: T, *args: Any, **kwargs: Any) -> None:
            """Call the original constructor, and explain unknown fields."""
            try:
                original_init(self, *args, **kwargs)
            except TypeError as error:
                fields: list[str] = list(cls.__dataclass_fields__)  # type: ignore[attr-defined]
                unknown = [name for name in kwargs if name not in fields]
                if not unknown:
                    raise

                suggestions = "".join(did_you_mean(name, fields) for name in unknown)
                raise TypeError(
                    f"{cls.__name__}: expected only {fields}, got {unknown}{suggestions or hint}"
                ) from error

        cls.__init__ = init  # type: ignore[method-assign, assignment]
        return cls

    return decorate
