"""The non-public names of Ray that this package uses, as they appear in its code.

`python tests/support/ray_names.py` lists the names in `USES`, and fails if the installed Ray lacks
one.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

from vlagents_ray.ray_tools.private import USES, first_missing

# tests/test_layout.py checks that no other module imports any.
ADAPTER = Path(__file__).parents[2] / "vlagents_ray" / "ray_tools" / "private.py"


def used(file: Path) -> set[str]:
    """Return the dotted names of Ray in a file that have a private part."""
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
    """Return whether the name has a private part; names like `__version__` are not private."""
    return any(part.startswith("_") and not part.endswith("__") for part in name.split("."))


def main() -> int:
    """Print the names, and return the exit status."""
    import ray

    lacking = 0
    print(f"Ray {ray.__version__}")
    for use in USES:
        print(f"\nwithout these, {use.consequence}:")
        for name in use.names:
            gone = first_missing(name)
            lacking += gone is not None
            print(f"  {name}" + ("" if gone is None else f"   MISSING: {gone}"))
    return int(lacking > 0)


if __name__ == "__main__":
    sys.exit(main())
