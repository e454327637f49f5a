"""Changes of settings on a command line, and settings files that are found by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from vlagents_ray import ConfigError
from vlagents_ray.overrides import (
    find_file,
    parse_overrides,
    parse_settings,
    read_config_file,
    with_overrides,
)

DOCUMENT: dict[str, Any] = {
    "gain": 0.5,
    "batch": {"max_size": 8},
    "envs": [{"name": "lift", "config": {"seed": 1}}, {"name": "stack"}],
    "table": {1: 10.0, 8: 30.0},
    "empty": None,
}

CHANGES: dict[str, tuple[str, Any]] = {
    "a value": ("gain=1", {"gain": 1}),
    "a value in a section": ("batch.max_size=4", {"batch": {"max_size": 4}}),
    "a value that was not there": ("batch.wait_ms=3", {"batch": {"max_size": 8, "wait_ms": 3}}),
    "a section that was not there": ("log.level=info", {"log": {"level": "info"}}),
    "a section that has nothing": ("empty.a=1", {"empty": {"a": 1}}),
    "an entry of a list": (
        "envs.0.config.seed=3",
        {"envs": [{"name": "lift", "config": {"seed": 3}}, {"name": "stack"}]},
    ),
    "a whole list": ("envs=[]", {"envs": []}),
    "a key that YAML reads as a number": ("table.8=25", {"table": {1: 10.0, 8: 25}}),
    "a new key among numbers": ("table.16=60", {"table": {1: 10.0, 8: 30.0, 16: 60}}),
    "a new key": ("+batch.wait_ms=3", {"batch": {"max_size": 8, "wait_ms": 3}}),
    "a new section": ("+log.level=info", {"log": {"level": "info"}}),
    "a value, new or not": ("++gain=1", {"gain": 1}),
    "a text with an equals sign": ("gain=a=b", {"gain": "a=b"}),
    "no value": ("gain=", {"gain": None}),
}


@pytest.mark.parametrize(("text", "changed"), CHANGES.values(), ids=CHANGES)
def test_a_change(text: str, changed: dict[str, Any]) -> None:
    before = repr(DOCUMENT)
    assert with_overrides(DOCUMENT, parse_overrides([text], "--set")) == DOCUMENT | changed
    assert repr(DOCUMENT) == before


REMOVALS: dict[str, tuple[str, Any]] = {
    "a key": ("~gain", lambda document: document.pop("gain")),
    "a key in a section": ("~batch.max_size", lambda document: document["batch"].pop("max_size")),
    "an entry of a list": ("~envs.0", lambda document: document["envs"].pop(0)),
    "a number": ("~table.8", lambda document: document["table"].pop(8)),
}


@pytest.mark.parametrize(("text", "remove"), REMOVALS.values(), ids=REMOVALS)
def test_a_removal(text: str, remove: Any) -> None:
    expected = with_overrides(DOCUMENT, [])
    remove(expected)
    assert with_overrides(DOCUMENT, parse_overrides([text], "--set")) == expected


def test_entries_are_appended_and_filled_in_order() -> None:
    texts = ["+envs.2.name=slide", "envs.2.config.seed=5", "~envs.0"]
    changed = with_overrides(DOCUMENT, parse_overrides(texts, "--set"))
    assert changed["envs"] == [{"name": "stack"}, {"name": "slide", "config": {"seed": 5}}]


ERRORS: dict[str, tuple[str, str]] = {
    "no value": (
        "gain",
        r"--set: expected KEY=VALUE, \+KEY=VALUE or ~KEY, as in batch.max_size=8, got 'gain'",
    ),
    "no key": ("=3", r"--set: expected KEY=VALUE, \+KEY=VALUE or ~KEY, .* got '=3'"),
    "an empty part": ("a..b=3", "got 'a..b=3'"),
    "only a plus": ("+=3", r"got '\+=3'"),
    "a removal with a value": ("~gain=3", "got '~gain=3'"),
    "not YAML": ("gain=[1", "the value of 'gain' is not YAML"),
    "new, but it is there": (
        "+gain=3",
        r"--set \+gain=3: expected a new key, got an existing key with the value 0.5; leave out the",
    ),
    "a list that is appended to, but has the entry": (
        "+envs.1=x",
        r"expected a new key, got an existing key with the value \{'name': 'stack'\}",
    ),
    "removed, but it is not there": (
        "~gian",
        "expected an existing key, .*'gain', .* got 'gian'; did you mean 'gain'",
    ),
    "removed from a section that is not there": ("~bach.max_size", "did you mean 'batch'"),
    "removed from a list that is shorter": (
        "~envs.2",
        "expected the number of an entry of a list, 0 to 1, got 2",
    ),
    "an entry that is not there": (
        "envs.2.name=x",
        r"list, 0 to 1, got 2; append an entry with '\+' and the number 2",
    ),
    "an entry after the next": ("+envs.3=x", "got 3; append an entry with"),
    "an entry by its name": ("envs.lift.seed=1", "entry of a list, 0 to 1, got 'lift'"),
    "an entry with a sign": ("envs.-1=x", "entry of a list, 0 to 1, got '-1'"),
    "below a number": (
        "gain.a=1",
        "--set gain.a=1: expected a mapping or a list at 'gain', to set 'a' in it, got 0.5",
    ),
}


@pytest.mark.parametrize(("text", "message"), ERRORS.values(), ids=ERRORS)
def test_a_change_that_is_not_possible(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        with_overrides(DOCUMENT, parse_overrides([text], "--set"))


def test_settings_are_changes_of_nothing() -> None:
    assert parse_settings(["a.b=1", "+a.c=[1, 2]", "d=x"], "--set") == {
        "a": {"b": 1, "c": [1, 2]},
        "d": "x",
    }
    with pytest.raises(ConfigError, match="but there is none"):
        parse_settings(["~a"], "--set")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("nightly.yaml", "weekly.yml", "pi0.yaml"):
        (tmp_path / name).write_text("a: 1\n")
    return tmp_path


FOUND = {
    "nightly": "nightly.yaml",
    "nightly.yaml": "nightly.yaml",
    "weekly": "weekly.yml",
    "pi0": "pi0.yaml",  # also the name of a policy
}


@pytest.mark.parametrize(("name", "file"), FOUND.items())
def test_a_file_is_found_by_its_name(folder: Path, name: str, file: str) -> None:
    assert find_file(name, folder, others=["pi0", "noop"]) == str(folder / file)


@pytest.mark.parametrize("source", ["noop", "http://127.0.0.1:8000", "module:Class"])
def test_other_sources_stay(folder: Path, source: str) -> None:
    assert find_file(source, folder, others=["pi0", "noop"]) == source


def test_without_a_folder_and_for_a_path_nothing_is_searched(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    assert find_file("nightly", None) == "nightly"
    assert find_file("nightly.yaml", folder / "absent") == "nightly.yaml"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nightli", r"one of \['nightly', 'pi0', 'weekly'\], got a name.*did you mean 'nightly'"),
        ("nightli.yaml", "'weekly.yml'.*did you mean 'nightly.yaml'"),
        ("nop", "did you mean 'noop'"),
        ("zzz", "zzz.*; check the name"),
    ],
)
def test_a_name_that_is_not_there(folder: Path, name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        find_file(name, folder, others=["noop"])


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--config-dir: expected a folder, got .*conf"):
        find_file("nightly", tmp_path / "conf")


def test_a_file_is_read_and_changed(folder: Path) -> None:
    overrides = parse_overrides(["a=2"], "--set")
    assert read_config_file(folder / "pi0.yaml", "file", "`a`", overrides=overrides) == {"a": 2}
