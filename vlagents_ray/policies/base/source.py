"""Model code that no package index has: imported from a checkout of its repository."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from vlagents_ray.errors import ConfigError


def use_source(package: str, variable: str, source_dir: str | None = None, within: Sequence[str] = (".",)) -> None:
    """Make `package` importable: from `source_dir`, from the checkout that `variable` names, or as it is installed.

    What is named comes first, as Python takes any folder of the package's name for it, such as a checkout in the
    working directory. `within` are the checkout's folders to import from; the first one holds `package`. Raises
    `ConfigError` where it is in none of them.
    """
    checkout = source_dir or os.environ.get(variable)
    if not checkout and importlib.util.find_spec(package) is not None:
        return
    folders = [] if not checkout else [Path(checkout).expanduser().resolve() / folder for folder in within]
    if not folders or not (folders[0] / package).is_dir():
        where = f"${variable}, which is not set" if not checkout else f"{checkout!r}"
        raise ConfigError(
            f"{package!r}: neither installed nor in {where}; check out its repository, and name that folder as the "
            f"policy's source_dir or in {variable}"
        )
    sys.path[:0] = [str(folder) for folder in folders if str(folder) not in sys.path]
