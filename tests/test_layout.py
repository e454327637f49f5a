"""The layout that ARCHITECTURE.md describes, as far as import-linter does not hold it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import tomllib

import vlagents_ray

PACKAGE = Path(vlagents_ray.__file__).parent
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}
# As `ray._raylet`, `ray.serve._private.api`, or a name with an underscore that is imported from Ray.
_PRIVATE = re.compile(r"\bray(\.\w+)*\._\w|^\s*from ray\S* import .*\b_\w", re.MULTILINE)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text())


def imports(module: str) -> Iterator[str]:
    """The modules that one imports, those included that only a type checker, or a function, does."""
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in FILES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def circles(edges: dict[str, set[str]]) -> list[set[str]]:
    """The groups in which each is reached from each."""
    reached = {start: _reached(start, edges) for start in edges}
    groups = {frozenset(other for other in reached[one] if one in reached.get(other, ())) for one in edges}
    return [set(group) for group in groups if len(group) > 1]


def _reached(start: str, edges: dict[str, set[str]]) -> set[str]:
    found: set[str] = set()
    left = [start]
    while left:
        new = edges.get(left.pop(), set()) - found
        found |= new
        left += new
    return found


def test_no_module_imports_itself_by_way_of_others() -> None:
    edges = {module: {name for name in imports(module) if name in FILES and name != module} for module in FILES}
    assert circles(edges) == []


def test_a_circle_would_be_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]


def test_private_names_of_ray_are_in_one_module() -> None:
    users = {module for module, path in FILES.items() if _PRIVATE.search(path.read_text())}
    by_value = "vlagents_ray.serve.scaling.router"  # may import nothing of this package
    assert users == {"vlagents_ray.ray_tools.private", by_value}


def test_a_plugin_asks_for_the_package_of_its_own_version() -> None:
    root = PACKAGE.parent
    ours = tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"]
    found = [tomllib.loads(path.read_text())["project"] for path in sorted(root.glob("plugins/*/pyproject.toml"))]
    assert [project["name"] for project in found] == [
        "lerobot_policy_vlagents",
        "vlagents_ray_arro",
        "vlagents-ray-cluster",
        "vlagents-ray-dialects",
        "vlagents-ray-learn",
        "vlagents-ray-sims",
    ]
    assert {project["version"] for project in found} == {ours}
    asked = [{re.sub(r"\[.*\]", "", one) for one in project["dependencies"]} for project in found]
    assert all(f"vlagents-ray>={ours}" in one for one in asked)
