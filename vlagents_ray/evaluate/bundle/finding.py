"""What a check of a bundle found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["equal", "differs", "other here", "not checked"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check.

    "differs" means that the bundle contradicts itself, or that a replay had another outcome; "other here" that software
    or numbers here are not those there, which alone is no fault of the bundle.
    """

    subject: str
    verdict: Verdict
    detail: str
