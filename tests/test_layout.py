"""The parts of the layout in ARCHITECTURE.md that import-linter does not check."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import tomllib
from packaging.requirements import Requirement

import vlagents_ray

PACKAGE = Path(vlagents_ray.__file__).parent
FILES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}
# Private names such as `ray._raylet`, `ray.serve._private.api`, or a name with an underscore that
# is imported from Ray.
_PRIVATE = re.compile(r"\bray(\.\w+)*\._\w|^\s*from ray\S* import .*\b_\w", re.MULTILINE)


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text())


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements below a node, without expressions, which are most of a tree."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        below = getattr(node, name, None)
        for one in below if isinstance(below, list) else ():
            yield one
            yield from statements(one)


def imports(module: str) -> Iterator[str]:
    """Yield the modules that a module imports, including imports for type checkers and in
    functions.
    """
    for node in statements(tree(module)):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in FILES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def circles(edges: dict[str, set[str]]) -> list[set[str]]:
    """Return the groups of modules that import each other, directly or indirectly."""
    reached = {start: _reached(start, edges) for start in edges}
    groups = {
        frozenset(other for other in reached[one] if one in reached.get(other, ())) for one in edges
    }
    return [set(group) for group in groups if len(group) > 1]


def _reached(start: str, edges: dict[str, set[str]]) -> set[str]:
    found: set[str] = set()
    left = [start]
    while left:
        new = edges.get(left.pop(), set()) - found
        found |= new
        left += new
    return found


@pytest.mark.slow
def test_no_module_imports_itself_by_way_of_others() -> None:
    edges = {
        module: {name for name in imports(module) if name in FILES and name != module}
        for module in FILES
    }
    assert circles(edges) == []


def test_a_circle_would_be_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [{"a", "b", "c"}]


def test_private_names_of_ray_are_in_one_module() -> None:
    users = {module for module, path in FILES.items() if _PRIVATE.search(path.read_text())}
    assert users == {"vlagents_ray.ray_tools.private"}


ROOT = PACKAGE.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = {
    path.parent.name: tomllib.loads(path.read_text())["project"]
    for path in sorted(ROOT.glob("plugins/*/pyproject.toml"))
}
OF_SERVER = {name: project for name, project in PLUGINS.items() if name.startswith("vlagents_ray_")}
DISTRIBUTIONS = {project["name"] for project in OF_SERVER.values()}


@pytest.mark.parametrize("name", PLUGINS)
def test_a_plugin_asks_for_the_package_of_its_own_version(name: str) -> None:
    version = PYPROJECT["project"]["version"]
    assert PLUGINS[name]["version"] == version
    without_extras = {re.sub(r"\[.*\]", "", text) for text in PLUGINS[name]["dependencies"]}
    assert f"vlagents-ray>={version}" in without_extras


def test_a_plugins_distribution_has_the_name_of_its_package() -> None:
    assert {name.replace("_", "-") for name in OF_SERVER} == DISTRIBUTIONS


def test_each_list_of_plugins_has_all_of_them() -> None:
    """A plug-in that is missing in a list would not be installed, checked, or kept out of
    the core.
    """
    tools = PYPROJECT["tool"]
    extra = PYPROJECT["project"]["optional-dependencies"]["all"]
    assert {Requirement(text).name for text in extra} == {"vlagents-ray", *DISTRIBUTIONS}
    assert tools["uv"]["sources"].keys() == {"vlagents-ray", *DISTRIBUTIONS}
    assert tools["uv"]["workspace"]["members"] == ["plugins/vlagents_ray_*"]
    assert {
        name for name in tools["mypy"]["packages"] if name.startswith("vlagents_ray_")
    } == OF_SERVER.keys()
    contracts = {contract["name"]: contract for contract in tools["importlinter"]["contracts"]}
    assert set(contracts["the core knows no plug-in"]["forbidden_modules"]) == OF_SERVER.keys()
    [installed] = re.findall(r"^PLUGINS \?= (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {f"vlagents_ray_{name}" for name in installed.split()} == OF_SERVER.keys()


def test_architecture_names_each_module_and_folder_of_the_package_and_each_plugin() -> None:
    tree = (ROOT / "ARCHITECTURE.md").read_text()
    tops = {
        path.name
        for path in PACKAGE.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    unnamed = sorted(name for name in tops - {"__init__.py", "__main__.py"} if name not in tree)
    assert unnamed == []
    assert [name for name in PLUGINS if name not in tree] == []


@pytest.mark.parametrize("name", PLUGINS)
def test_a_plugins_readme_links_to_pages_that_exist(name: str) -> None:
    folder = ROOT / "plugins" / name
    pages = re.findall(r"\]\((\.\./[^)#]+)", (folder / "README.md").read_text())
    assert "../../README.md" in pages
    assert [page for page in pages if not (folder / page).exists()] == []


# Files and folders of tests/ that import plug-ins, with the reason. All other tests need only the
# core.
ABOVE_PLUGINS = {
    "cli/test_examples.py": "the help of each command has examples, also of plug-ins",
    "cli/test_config_files.py": "one table has each command that reads a file",
    "client/test_hostile_server.py": "one server is slow to clients of the core and of dialects",
    "evaluate/report/test_families.py": "results of one run and merged ones have the same rates",
    "evaluate/test_program.py": "resumed and merged results have the same rule",
    "golden": "golden files have the messages of all protocols",
    "integration": "whole servers, with what is installed beside them",
    "policies/test_reference_training.py": "programs of examples/reference use plug-ins",
    "policies/test_reference_weights.py": "it verifies bundles",
    "serve/test_flood.py": "one harness attacks the ports of all protocols",
    "serve/test_fuzz_before_keys.py": "one harness attacks the ports of all protocols",
    "serve/test_overload.py": "one harness attacks the ports of all protocols",
    "serve/test_page_headers.py": "a rule of all pages that are served",
    "support": "helpers that tests here and of plug-ins share",
    "test_docs.py": "pages of the workspace describe plug-ins",
    "test_page_protocol.py": "a rule of all pages that are served",
}


def _imports_plugin(path: Path) -> bool:
    text = path.read_text()
    if not any(name in text for name in PLUGINS):
        return False
    for node in statements(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            modules = [node.module or ""]
        elif isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        else:
            continue
        if any(module.partition(".")[0] in PLUGINS for module in modules):
            return True
    return False


def test_tests_of_the_core_import_no_plugin_but_those_of_the_workspace() -> None:
    tests = ROOT / "tests"
    importing = {
        str(path.relative_to(tests)) for path in tests.rglob("*.py") if _imports_plugin(path)
    }
    excepted = {
        path: exception
        for path in importing
        for exception in ABOVE_PLUGINS
        if path == exception or path.startswith(f"{exception}/")
    }
    assert sorted(importing - excepted.keys()) == [], "move it to the tests of that plug-in"
    assert sorted(ABOVE_PLUGINS.keys() - set(excepted.values())) == [], (
        "does not import a plug-in any more"
    )
