"""Batches in which a row may be an error, which is the result of its session's request alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any


def attempt(function: Callable[..., Any], *args: Any) -> Any:
    """Return the function's result, or the exception that it raises."""
    try:
        return function(*args)
    except Exception as error:  # noqa: BLE001 - returned to the session whose request failed
        return error


def compute_valid(rows: Sequence[Any], compute: Callable[[list[Any]], Iterable[Any]]) -> list[Any]:
    """Compute the rows of a batch that are not exceptions, in one call.

    Returns:
        The results and the exceptions, in the order of the rows.
    """
    valid = [index for index, row in enumerate(rows) if not isinstance(row, Exception)]
    results = list(rows)
    if valid:
        computed = compute([rows[index] for index in valid])
        for index, result in zip(valid, computed, strict=True):
            results[index] = result
    return results
