"""The docstrings of public names have whole sentences, and describe each argument by name."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from surface import MODULES

from vlagents_ray import registry

# A summary that begins with one of these words is a fragment, which is clear only next to the name.
FRAGMENTS = {
    "as",
    "how",
    "it",
    "likewise",
    "of",
    "that",
    "these",
    "they",
    "this",
    "those",
    "what",
    "which",
    "who",
}

ROOT = Path(__file__).parents[1]
SOURCES = ("vlagents_ray", "plugins", "examples", "benchmarks")
INDENTED = re.compile(r"(?:^ {4}.*\n|^\n(?= {4}))+", re.MULTILINE)
# An indented block in a docstring that begins like this is Python.
PYTHON = re.compile(r"(from|import|with|for) .*|\w+(\.\w+)*(, \w+)* = .*")


@dataclass(frozen=True)
class Documented:
    """A public class, function, method or property."""

    name: str
    doc: str
    parameters: tuple[str, ...] = ()
    returns: bool = False

    def faults(self) -> Iterator[str]:
        """Return the faults of the docstring, in words."""
        summary = " ".join(self.doc.partition("\n\n")[0].split())
        words = re.findall(r"[\w'.`]+", summary)
        if (
            len(words) < 3
            or not re.match(r"[A-Z0-9`(]", summary)
            or not re.search(r"[.:]$", summary)
        ):
            yield f"{self.name}: got the summary {summary!r}, want a whole sentence"
        elif words[0].lower() in FRAGMENTS:
            yield (
                f"{self.name}: got the summary {summary!r}, want a sentence that does not begin "
                f"with {words[0]!r}"
            )
        if len(self.parameters) > 1:
            named = set(
                re.findall(r"(?m)^    \*{0,2}(\w+)(?: \([^)]*\))?: \S", section(self.doc, "Args"))
            )
            if lacking := [name for name in self.parameters if name not in named]:
                yield f"{self.name}: no line in Args for {', '.join(lacking)}"
            if self.returns and not section(self.doc, "Returns"):
                yield f"{self.name}: no Returns"


def section(doc: str, title: str) -> str:
    """Return the indented lines below `title:`; "" if there are none."""
    found = re.search(rf"(?ms)^{title}:\n((?:    .*?(?:\n|\Z)|\n)+)", doc)
    return found[1] if found else ""


def public_names() -> Iterator[tuple[str, Any]]:
    """Yield each name that users import, with its full name."""
    for module in MODULES:
        loaded = importlib.import_module(module)
        yield from ((f"{module}.{name}", getattr(loaded, name)) for name in loaded.__all__)
    for one in registry.entries("policies").values():
        module, _, name = one.target.partition(":")
        yield f"{module}.{name}", getattr(importlib.import_module(module), name)


def documented(name: str, value: Any) -> Iterator[Documented]:
    """Yield the docstring of a public name. For a class, also yield those of its methods and
    properties.

    A method that overrides another one inherits its docstring, or only the description of its
    arguments.
    """
    if inspect.isfunction(value):
        yield of_function(name, value)
    elif inspect.isclass(value):
        yield of_class(name, value)
        for key, member in vars(value).items():
            function = (
                member.__func__ if isinstance(member, (classmethod, staticmethod)) else member
            )
            if key.startswith("_") and key != "__call__":
                continue
            if isinstance(member, property):
                yield Documented(f"{name}.{key}", inspect.getdoc(getattr(value, key)) or "")
            elif inspect.isfunction(function):
                inherited = any(hasattr(base, key) for base in value.__mro__[1:])
                if not (inherited and function.__doc__ is None):
                    found = of_function(
                        f"{name}.{key}", function, method=not isinstance(member, staticmethod)
                    )
                    yield dataclasses.replace(found, parameters=()) if inherited else found


def of_function(name: str, function: Callable[..., Any], *, method: bool = False) -> Documented:
    parameters = tuple(inspect.signature(function).parameters)[method:]
    returned = str(inspect.get_annotations(function).get("return"))
    returns = returned not in ("None", "NoReturn") and not returned.startswith(
        ("Iterator", "Generator")
    )
    return Documented(name, inspect.getdoc(function) or "", parameters, returns)


def of_class(name: str, cls: type[Any]) -> Documented:
    """Return a class's docstring with its constructor's. A dataclass documents its arguments at the
    fields.
    """
    own = vars(cls).get("__init__")
    doc = inspect.cleandoc(cls.__doc__ or "")
    # Python adds a constructor to a protocol, and to a class that inherits from one when it is
    # first called.
    inherited = not inspect.isfunction(own) or own.__module__ == "typing"
    if inherited or (dataclasses.is_dataclass(cls) and own.__doc__ is None):
        return Documented(name, doc)
    constructor = inspect.cleandoc(own.__doc__ or "")
    return Documented(
        name, f"{doc}\n\n{constructor}".strip(), tuple(inspect.signature(own).parameters)[1:]
    )


def test_public_docstrings_are_whole_sentences_and_name_their_arguments() -> None:
    faults = [
        fault for found in public_names() for one in documented(*found) for fault in one.faults()
    ]
    assert faults == [], "\n" + "\n".join(faults)


@pytest.mark.parametrize(
    ("doc", "fault"),
    [
        ("", "whole sentence"),
        ("Likewise.", "whole sentence"),
        ("Of one camera in one episode.", "does not begin with"),
        ("Add two numbers.", "no line in Args for a, b"),
        ("Add two numbers.\n\nArgs:\n    a: The first.\n", "no line in Args for b"),
        ("Add two numbers.\n\nArgs:\n    a: The first.\n    b: The second.\n", "no Returns"),
    ],
)
def test_a_bad_docstring_is_found(doc: str, fault: str) -> None:
    assert fault in "".join(Documented("add", doc, ("a", "b"), returns=True).faults())


def test_a_good_docstring_has_no_fault() -> None:
    doc = (
        "Add two numbers.\n"
        "\n"
        "Args:\n"
        "    a: The first.\n"
        "    b: The second.\n"
        "\n"
        "Returns:\n"
        "    Their sum.\n"
    )
    assert list(Documented("add", doc, ("a", "b"), returns=True).faults()) == []


def wrong_examples(source: str) -> list[str]:
    """Return the invalid Python examples in the docstrings of a module, such as those that were
    wrapped like prose.
    """
    wrong = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        docstring = ast.get_docstring(node) or ""
        for block in INDENTED.findall(docstring + "\n"):
            example = textwrap.dedent(block.strip("\n"))
            if not PYTHON.match(example):
                continue
            try:
                ast.parse(example)
            except SyntaxError:
                wrong.append(example)
    return wrong


@pytest.mark.slow
def test_examples_in_docstrings_are_valid_python() -> None:
    wrong = {}
    for folder in SOURCES:
        for path in (ROOT / folder).rglob("*.py"):
            examples = wrong_examples(path.read_text())
            if examples:
                wrong[str(path.relative_to(ROOT))] = examples
    assert wrong == {}


def test_a_wrapped_example_is_found() -> None:
    wrapped = 'config = Config(\n    out="a") summary = run(config)'
    docstring = textwrap.indent(wrapped, "    ")
    assert wrong_examples(f"'''An example.\n\n{docstring}\n\nIt ends.\n'''") == [wrapped]
