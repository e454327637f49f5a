"""Extraction of texts from docstrings."""

from __future__ import annotations


def summary_of(documented: object) -> str:
    """Return the first paragraph of an object's docstring on one line; "" without a docstring."""
    paragraph = (documented.__doc__ or "").strip().partition("\n\n")[0]
    return " ".join(paragraph.split())
