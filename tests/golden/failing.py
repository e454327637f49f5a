"""The line at which the recorded policy fails: errors contain its number, which must not change."""

from typing import NoReturn


def fail() -> NoReturn:
    """Raise an error whose text no client may receive."""
    raise RuntimeError("a secret")
