"""The line at which the recorded policy fails, which errors name; in its own file, so that no other edit moves it."""

from typing import NoReturn


def fail() -> NoReturn:
    """Raise what no client may see."""
    raise RuntimeError("a secret")
