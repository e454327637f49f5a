"""Functions for Python code of models that is not part of this package.

Such code is in a checkout of the authors' repository, in a checkpoint, or in a hub repository that
a checkpoint names. The code of a checkpoint runs with all rights of this process.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

CURE = "if you trust everyone with write access to it, set trust_remote_code: true"


def use_source(
    package: str, variable: str, source_dir: str | None = None, within: Sequence[str] = (".",)
) -> None:
    """Make `package` importable: from `source_dir`, from the checkout that `variable` names, or
    from an installation.

    A named checkout has priority over an installation, since Python would import any folder with
    the package's name, such as a checkout in the working directory.

    Args:
        package: The name of the package.
        variable: The environment variable that names a checkout.
        source_dir: A checkout that is used instead of the one in the variable.
        within: The folders of the checkout from which modules are imported. The first folder
            contains `package`.

    Raises:
        ConfigError: The package is neither in the checkout nor installed.
    """
    checkout = source_dir or os.environ.get(variable)
    if not checkout and importlib.util.find_spec(package) is not None:
        return

    folders: list[Path] = []
    if checkout:
        root = Path(checkout).expanduser().resolve()
        folders = [root / folder for folder in within]
    if not folders or not (folders[0] / package).is_dir():
        where = f"${variable}, which is not set" if not checkout else f"{checkout!r}"
        raise ConfigError(
            f"{package!r}: neither installed nor in {where}; check out its repository, and name "
            f"that folder as the policy's source_dir or in {variable}"
        )

    sys.path[:0] = [str(folder) for folder in folders if str(folder) not in sys.path]


@contextlib.contextmanager
def remote_code(*, allowed: bool, source: Path | None = None) -> Iterator[None]:
    """Within the context, prevent transformers from importing code of a checkpoint or of a hub
    repository, unless such code is allowed.

    This includes code that a library requests: some libraries pass `trust_remote_code=True` with a
    name that they read from the checkpoint.

    Args:
        allowed: Whether all code may be imported.
        source: The folder of a family's own code, which may be imported. Some families let
            transformers import a part of their code.

    Raises:
        ConfigError: A model in this context needs code that may not be imported.
    """
    if allowed or importlib.util.find_spec("transformers") is None:
        yield
        return
    dynamic: Any = require("transformers.dynamic_module_utils")
    # All imports of such code call these three functions. The first finds the code and calls the
    # second, which copies the code to the cache. The third executes the code.
    names = ("get_cached_module_file", "create_dynamic_module", "get_class_in_module")
    originals = [getattr(dynamic, name) for name in names]
    find, create, execute = originals
    own_copies: set[str] = set()  # paths of the copies of files of `source`
    finding_own = False  # whether `find` is running for a file of `source`

    def reject(name: Any) -> NoReturn:
        raise ConfigError(
            f"{str(name)!r}: is Python code of the checkpoint, or of what it names on the hub; "
            f"{CURE}"
        )

    def find_own(folder: Any, *args: Any, **options: Any) -> Any:
        nonlocal finding_own
        path = Path(folder)
        finding_own = (
            source is not None and path.is_dir() and source.resolve() in path.resolve().parents
        )
        try:
            copy = find(folder, *args, **options)
            if finding_own:
                own_copies.add(copy)
        finally:
            finding_own = False
        return copy

    def create_own(name: Any, *args: Any, **options: Any) -> Any:
        return create(name, *args, **options) if finding_own else reject(name)

    def execute_own(name: Any, copy: Any, *args: Any, **options: Any) -> Any:
        return execute(name, copy, *args, **options) if copy in own_copies else reject(name)

    for name, replacement in zip(names, (find_own, create_own, execute_own), strict=True):
        setattr(dynamic, name, replacement)
    try:
        yield
    finally:
        for name, original in zip(names, originals, strict=True):
            setattr(dynamic, name, original)
