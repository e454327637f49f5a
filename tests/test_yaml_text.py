"""YAML: one reader for all files, which loses no key."""

from __future__ import annotations

import ast
import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner
from wrong_yaml import WRONG

import vlagents_ray
from vlagents_ray import ConfigError
from vlagents_ray.cli.main import app
from vlagents_ray.cli.options import read_run_file
from vlagents_ray.overrides import parse_settings
from vlagents_ray.robot.limits import MotionLimits
from vlagents_ray.serve.access.key_store import read_keys
from vlagents_ray.serve.launch.deployment_file import read_deployment
from vlagents_ray.yaml_text import load_yaml

TEXTS = st.text(st.characters(codec="ascii", exclude_categories=("C",)), max_size=6)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=8,
)


@given(VALUES)
def test_what_yaml_writes_is_read(value: Any) -> None:
    assert load_yaml(yaml.safe_dump(value)) == value
    assert load_yaml(json.dumps(value)) == value


@pytest.mark.parametrize(
    "text",
    [
        "a: 1\na: 1",
        "x:\n  a: 1\n  b: 2\n  a: 3",
        "[{a: 1, b: 2, a: 3}]",
        "{1: a, 1: b}",
        '{"a": 1, a: 2}',
    ],
)
def test_a_key_that_is_written_twice_is_an_error_at_any_depth(text: str) -> None:
    with pytest.raises(ValueError, match="is written twice"):
        load_yaml(text)


def test_a_merged_key_may_be_replaced() -> None:
    assert load_yaml("base: &b {a: 1, c: 2}\nx:\n  <<: *b\n  a: 3") == {
        "base": {"a": 1, "c": 2},
        "x": {"a": 3, "c": 2},
    }


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e12", 1e12),
        ("1e-4", 1e-4),
        ("-2.5E3", -2500.0),
        (".5e1", 5.0),
        ("1_000", 1000),
        ("e12", "e12"),
        ("1e", "1e"),
    ],
)
def test_a_number_with_an_exponent_is_a_number(text: str, value: object) -> None:
    assert load_yaml(text) == value
    assert type(load_yaml(text)) is type(value)


READERS = {
    "deployment": ("x.yaml", lambda file: read_deployment(str(file))),
    "run": ("x.yaml", lambda file: read_run_file(file, "run file", "`policies`")),
    "limits": ("x.yaml", MotionLimits.read),
    "limits as JSON": ("x.json", MotionLimits.read),
    "keys": ("x.json", read_keys),
    "setting": ("x.txt", lambda file: parse_settings([f"a={file.read_text()}"], "--set")),
}


NO_MISTAKES = {("setting", "a tab"), ("setting", "not UTF-8")}  # valid as text on a command line
CASES = [case for case in itertools.product(READERS, WRONG) if case not in NO_MISTAKES]


@pytest.mark.slow
@pytest.mark.parametrize(("reader", "wrong"), CASES)
def test_each_reader_answers_a_wrong_text_with_its_file(
    reader: str, wrong: str, tmp_path: Path
) -> None:
    name, read = READERS[reader]
    text, says = WRONG[wrong]
    (tmp_path / name).write_bytes(text)
    with pytest.raises(ConfigError) as raised:
        read(tmp_path / name)  # type: ignore[no-untyped-call]
    assert says in str(raised.value)
    assert name in str(raised.value) or reader in ("setting", "keys")


def test_a_file_of_runs_with_a_key_twice_is_an_error_of_the_command(tmp_path: Path) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text(
        "policies: [{source: noop}]\nsuites: [{envs: [tabletop]}]\nworkers: 0\nworkers: 3\n"
    )
    done = CliRunner().invoke(app, ["eval", str(file), "--dry-run"])
    assert done.exit_code == 2
    assert "the key 'workers' is written twice" in done.stderr
    assert "keep one of the two" in done.stderr


@pytest.mark.slow
def test_no_other_module_reads_yaml() -> None:
    folder = Path(vlagents_ray.__file__).parent
    readers = set()
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in (
                "safe_load",
                "safe_load_all",
                "SafeLoader",
            ):
                readers.add(file.relative_to(folder).as_posix())
    assert readers == {"yaml_text.py"}


BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 8)]
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BOMB, "aliases .* stand for more than 10000 values"),
        ("a: &a [*a]", "names a value that contains it"),
        ("a: &a {b: [1, {c: *a}]}", "names a value that contains it"),
        ("a: &a {<<: *a}", "names a value that contains it"),
    ],
)
def test_aliases_must_not_make_a_document_large(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_yaml(text)


def test_ordinary_aliases_and_large_documents_are_read() -> None:
    assert load_yaml("a: &a {b: 1}\nc: {<<: *a, d: *a}") == {
        "a": {"b": 1},
        "c": {"b": 1, "d": {"b": 1}},
    }
    assert len(load_yaml("\n".join(f"- {n}" for n in range(20_000)))) == 20_000
