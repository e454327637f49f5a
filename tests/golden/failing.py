"""The line at which the recorded policy fails, which errors name; alone, so that it stays there."""

from typing import NoReturn


def fail() -> NoReturn:
    """Raise what no client may see."""
    raise RuntimeError("a secret")
