"""The program of an episode: versions of software, digests of the files of a policy or an
environment, and the values with which a factory makes a policy.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import inspect
import json
import platform
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vlagents_ray.policies.base.checkpoint import STEP, at_step
from vlagents_ray.policies.base.checkpoint_files import METHOD, digest, files_in
from vlagents_ray.ray_tools.git_state import code_of

# Classes of this package are identified by its version and commit (see `software`).
_PACKAGE = "vlagents_ray"
_LIBRARY_NAMES = ("stdlib", "platstdlib", "purelib", "platlib")
_LIBRARIES = tuple(Path(sysconfig.get_path(name)).resolve() for name in _LIBRARY_NAMES)
_SITES = {"site-packages", "dist-packages"}
# A folder with at most this many files has a digest for each of them; a larger one has one digest.
_LISTED = 32
_LONGEST = 4096  # length of the longest path, characters

# Name of a file, a package or a value -> digest of the file, version of the package, or the value.
Program = dict[str, str]

# The packages whose version can change every episode: this package has the loop of episodes, the
# real-time clock, the built-in policies and environments, and numpy computes their numbers.
_PACKAGES = ("vlagents-ray", "ray", "numpy", "torch")
SOFTWARE = "software: "  # prefix of the names of their versions


@functools.cache
def software() -> Program:
    """Return the versions of Python and of the installed packages that each episode depends on, and
    the commit of this package.

    Patch releases of Python are included. The commit is known only if git tracks the package.
    """
    program = {f"{SOFTWARE}python": f"version {platform.python_version()}"}
    for name in _PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            program[f"{SOFTWARE}{name}"] = f"version {version(name)}"

    code = code_of(_PACKAGE)
    if code is not None:
        changes = f", changes sha256:{code.diff_sha256}" if code.diff_sha256 else ""
        program[f"{SOFTWARE}commit of vlagents-ray"] = code.commit + changes
    return program


def code_of_class(target: str) -> Program:
    """Return the digests of the module of a class, and of all modules that it imports.

    Modules that are imported indirectly are included. They are found as Python's `import` would
    find them, but nothing is imported: import statements are read from the source, including import
    statements in functions. Installed packages and the standard library are not included. A class
    in an installed package is identified by the version of its distribution. A class of this
    package has no entry.

    Args:
        target: "module:Class" or "module".

    Returns:
        `sha256:` and 64 digits for each file, by its path below the folder from which Python
        imports it.
    """
    module = target.partition(":")[0]
    top = module.partition(".")[0]
    if not top.isidentifier() or top == _PACKAGE:
        return {}

    digests: Program = {}
    pending, visited = [module], set()
    while pending:
        name = pending.pop()
        if name in visited:
            continue
        visited.add(name)
        if "." in name:
            pending.append(name.rpartition(".")[0])  # a package is executed before its modules

        file = _file(name)
        if file is None or not _is_own(file):
            continue
        content = file.read_bytes()
        package = name if file.stem == "__init__" else name.rpartition(".")[0]
        folder = Path(*package.split(".")) if package else Path()
        digests[(folder / file.name).as_posix()] = f"sha256:{hashlib.sha256(content).hexdigest()}"
        if file.suffix == ".py":
            pending += _imports(content, package)

    if digests or top == "__main__":
        return digests
    distributions = sorted(set(_distributions().get(top, ())))
    return {name: f"version {version(name)}" for name in distributions}


# A call takes half a second, since it reads the list of files of each installed package.
_distributions = functools.cache(packages_distributions)


loaded_code = functools.cache(code_of_class)
"""The result of the first call of `code_of_class` in this process.

Later edits of the files do not change the code that is running.
"""


def files_named(settings: Mapping[str, Any], *, folders: bool = True) -> Program:
    """Return the digests of the files that settings name.

    Args:
        settings: Each text that is the path of an existing file or folder is included, after
            `{step}` has been replaced by the setting `checkpoint_step`.
        folders: Whether the files of folders are included. A folder that contains the working
            directory never is.

    Returns:
        Setting and path, such as "checkpoint: runs/a/w.npz" -> digest.
    """
    step = settings.get("checkpoint_step")
    digests: Program = {}
    for name, text in _texts(settings):
        path = _existing(at_step(text, step) if isinstance(step, int) else text)
        if path is None:
            continue
        if path.is_file():
            digests[f"{name}: {path}"] = digest([path])
        elif folders and not Path.cwd().resolve().is_relative_to(path.resolve()):
            files = files_in(path)
            listed = files if len(files) <= _LISTED else [path]
            digests |= {f"{name}: {file}": digest([file]) for file in listed}
    return digests


def digest_of(files: Program) -> str:
    """Return one digest for all these files, independent of their paths on this machine."""
    digests = json.dumps(list(files.values())).encode()
    return f"{METHOD}:{hashlib.sha256(digests).hexdigest()}"


def with_defaults(cls: type[Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings, completed with the defaults of the class's `Config` and constructor."""
    fields = getattr(getattr(cls, "Config", None), "model_fields", {})
    defaults = {name: field.default for name, field in fields.items()}
    parameters = inspect.signature(cls.__init__).parameters.values()
    for parameter in parameters:
        if parameter.default is not inspect.Parameter.empty:
            defaults[parameter.name] = parameter.default
    return {**defaults, **settings}


def is_own_module(name: str) -> bool:
    """Return whether a module belongs to the user, or has no file, such as a notebook; the modules
    of this package, of installed packages and of the standard library do not.
    """
    if name.partition(".")[0] in (_PACKAGE, *sys.builtin_module_names, *sys.stdlib_module_names):
        return name == "__main__"
    file = _file(name)
    return file is None or _is_own(file)


def _file(name: str) -> Path | None:
    """Return the file that `import name` would execute.

    Returns:
        The file; None if there is none, or if it is in an installed package.
    """
    if name == "__main__":
        path = getattr(sys.modules[name], "__file__", None)
        return None if path is None else Path(path)
    spec = _spec(name)
    if spec is None or not spec.has_location or spec.origin is None:
        return None
    return Path(spec.origin)


def _spec(name: str) -> ModuleSpec | None:
    """Return the spec of a module without importing its packages.

    Returns:
        The spec; None if there is no such module, or if it is in an installed package.
    """
    parent, _, _ = name.rpartition(".")
    if not parent:
        try:
            return find_spec(name)  # This call imports nothing, since the name has no parent.
        except (ImportError, ValueError):  # The module has no spec.
            return None

    package = _spec(parent)
    if package is None or package.submodule_search_locations is None:
        return None
    if package.has_location and package.origin is not None and not _is_own(Path(package.origin)):
        return None
    return PathFinder.find_spec(name, list(package.submodule_search_locations))


def _is_own(file: Path) -> bool:
    """Return whether a file belongs to the user.

    Other files are in installed packages, in this package or in the standard library.
    """
    path = file.resolve()
    if _SITES & set(path.parts):
        return False
    this_package = Path(__file__).resolve().parents[2]
    return not any(path.is_relative_to(folder) for folder in (*_LIBRARIES, this_package))


# The sources of an environment are the same for each of its cases. 1,024 modules of usual size are
# about 10 MB.
@functools.lru_cache(maxsize=1024)
def _imports(source: bytes, package: str) -> tuple[str, ...]:
    """Return the full names of the modules that a source may import."""
    return tuple(_read_imports(source, package))


def _read_imports(source: bytes, package: str) -> Iterator[str]:
    """Yield the full names of the modules that a source may import.

    Args:
        source: The code of a module.
        package: The package of the module.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):  # Importing the module raises the same error.
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = []
            if node.level:  # The import is relative to the package.
                parents = package.split(".")
                names += parents[: len(parents) - node.level + 1]
            if node.module:
                names.append(node.module)
            base = ".".join(names)
            if not base:
                continue
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names if alias.name != "*")


def _texts(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the texts in nested settings, each with the dotted name of its setting."""
    if isinstance(value, str | Path):
        yield name, str(value)
    elif isinstance(value, Mapping):
        for key, nested in value.items():
            yield from _texts(nested, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for nested in value:
            yield from _texts(nested, name)


def _existing(text: str) -> Path | None:
    """Return the path that a text names; None if there is no such file or folder."""
    if not text.strip() or len(text) > _LONGEST or STEP in text or not text.isprintable():
        return None
    try:
        path = Path(text).expanduser()
        return path if path.exists() else None
    except (OSError, RuntimeError):
        # The name is too long for the file system, or is `~` of an unknown user.
        return None
