"""Settings are written into the text of a deployment file, of which everything else is kept."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from vlagents_ray.bench.tuning.yaml_text import Settings, with_comments, with_settings_in_text
from vlagents_ray.errors import ConfigError

FILE = """\
# Set the checkpoint, then serve it.
applications:
  - name: first  # the first
    import_path: vlagents_ray.serve.app:build
    args: {policy: noop, batch: {max_size: 4}}

  - import_path: vlagents_ray.serve.app:build  # without a name
    args:
      policy: pi0
      # where it is
      config:
        checkpoint: here  # a folder
        batch_sizes:
          - 1
          - 16
        # the end of config
      batch:
        max_size: 16  # rows
      dialects:
"""
TUNED: Settings = {("config", "compile"): True, ("config", "batch_sizes"): [1, 2], ("batch", "max_size"): 2}


def args(text: str, number: int) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(text)["applications"][number]["args"]
    return found


def test_lines_and_comments_are_kept() -> None:
    text = with_settings_in_text(FILE, "default", TUNED)
    kept = FILE.replace("        batch_sizes:\n          - 1\n          - 16\n", "        batch_sizes: [1, 2]\n")
    kept = kept.replace("max_size: 16  # rows", "max_size: 2  # rows")
    assert text == kept.replace("        checkpoint: here", "        compile: true\n        checkpoint: here")


def test_missing_sections_of_one_line_are_added() -> None:
    text = with_settings_in_text(FILE, "first", TUNED)
    assert args(text, 0) == {
        "policy": "noop",
        "batch": {"max_size": 2},
        "config": {"compile": True, "batch_sizes": [1, 2]},
    }
    assert args(text, 1) == args(FILE, 1)
    assert text.count("#") == FILE.count("#")


@pytest.mark.parametrize("nothing", ["", " null", " {}", " ~  # none"])
def test_a_section_that_is_empty_is_filled(nothing: str) -> None:
    text = f"applications:\n  - name: a\n    args:\n      config:{nothing}\n      policy: noop\n"
    edited = with_settings_in_text(text, "a", {("config", "dtype"): "bfloat16"})
    assert args(edited, 0) == {"config": {"dtype": "bfloat16"}, "policy": "noop"}
    assert edited.count("#") == text.count("#")


def test_settings_that_two_applications_share_are_changed_in_one_of_them() -> None:
    text = "applications:\n- {name: a, args: &args {policy: noop, batch: {max_size: 4}}}\n- {name: b, args: *args}\n"
    edited = with_settings_in_text(text, "b", {("batch", "max_size"): 8})
    assert [args(edited, number)["batch"]["max_size"] for number in (0, 1)] == [4, 8]


def test_nothing_to_change_changes_nothing() -> None:
    assert with_settings_in_text(FILE, "first", {}) == FILE


def test_an_application_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ConfigError, match="third"):
        with_settings_in_text(FILE, "third", TUNED)


def test_figures_are_comments_in_front_of_the_text() -> None:
    text = with_comments(FILE, ["Tuned."], [["", "sessions"], ["*", "8"]])
    assert text == "# Tuned.\n#    sessions\n# *  8\n\n" + FILE
