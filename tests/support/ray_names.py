"""The names of Ray that this package uses though they are not public, and whether the installed Ray
has them.

`python tests/support/ray_names.py` lists them, and fails if one is missing.
"""

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

PACKAGE = Path(__file__).parents[2] / "vlagents_ray"
# tests/test_layout.py holds that nothing else uses any.
PLACES = ("ray_tools/private.py", "serve/scaling/router.py")


def used(file: Path) -> set[str]:
    """The dotted names of Ray that a file uses, where a part of the name is private."""
    tree = ast.parse(file.read_text())
    known = {"ray": "ray"}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "ray":
            known |= {one.asname or one.name: f"{node.module}.{one.name}" for one in node.names}
        elif isinstance(node, ast.Import):
            known |= {
                one.asname: one.name
                for one in node.names
                if one.asname and one.name.startswith("ray.")
            }
    found = {name for name in known.values() if _is_private(name)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            root, *parts = ast.unparse(node).split(".")
            if root in known and all(part.isidentifier() for part in parts):
                found.add(".".join([known[root], *parts]))
    return {
        name
        for name in found
        if _is_private(name) and not any(other.startswith(f"{name}.") for other in found)
    }


def _is_private(name: str) -> bool:
    return any(part.startswith("_") for part in name.split("."))


def missing(name: str) -> str | None:
    """The first part of a name that the installed Ray lacks, as a dotted name; None if it has all.

    What only exists while Ray runs, the attributes of an object, is not looked for.
    """
    parts = name.split(".")
    found = importlib.import_module("ray")
    for i, part in enumerate(parts[1:], start=2):
        try:
            found = getattr(found, part)
        except AttributeError:
            try:
                found = importlib.import_module(".".join(parts[:i]))
            except ImportError:
                return ".".join(parts[:i]) if isinstance(found, type | ModuleType) else None
    return None


def main() -> int:
    """List them; return the exit status."""
    import ray

    lacking = 0
    print(f"Ray {ray.__version__}")
    for place in PLACES:
        print(f"\n{place}")
        for name in sorted(used(PACKAGE / place)):
            gone = missing(name)
            lacking += gone is not None
            print(f"  {name}" + ("" if gone is None else f"   MISSING: {gone}"))
    return int(lacking > 0)


if __name__ == "__main__":
    sys.exit(main())
