"""The parts of pages that are generated for the site (docs/generate)."""

from __future__ import annotations

import re
from dataclasses import replace

import generated
import pytest
import reference
from generated import PARTS, filled, page_of
from pydantic import BaseModel
from readme_blocks import DOCS

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.registry import RegistryEntry, entries
from vlagents_ray.serve.config.deployment import ServerArgs

MARKED = re.compile(r"^<!-- generated: (.*) -->$", re.MULTILINE)


def test_each_part_is_on_one_page_and_each_page_has_parts_that_exist() -> None:
    named = [name for page in DOCS.rglob("*.md") for name in MARKED.findall(page.read_text())]
    assert sorted(named) == sorted(PARTS)


def test_a_part_takes_the_place_of_the_text_for_readers_of_the_markdown() -> None:
    text = "Above.\n\n<!-- generated: columns -->\nOn the site.\n<!-- /generated -->\n\nBelow.\n"
    table = "\n".join(generated.columns())
    assert filled(text) == f"Above.\n\n{table}\n\nBelow.\n"
    assert filled("In a sentence, `<!-- generated: NAME -->` is text.").endswith("is text.")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<!-- generated: colums -->\n<!-- /generated -->", "'colums'"),
        ("<!-- generated: columns -->\nOn the site.", "<!-- /generated -->"),
        ("On the site.\n<!-- /generated -->", "<!-- generated: NAME -->"),
        (
            "<!-- generated: columns -->\n<!-- generated: columns -->\n<!-- /generated -->",
            "got one of them",
        ),
    ],
)
def test_a_part_without_a_name_or_an_end_is_an_error(text: str, says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        filled(text)


def test_each_policy_and_environment_has_a_page_and_each_page_one_of_them() -> None:
    for folder, kind, further in (
        ("policies", "policies", {"arro", "verification"}),
        ("benchmarks", "envs", set[str]()),
    ):
        named = {page_of(name, entry) for name, entry in entries(kind).items() if entry.about}
        pages = {page.stem for page in (DOCS / folder).glob("*.md")}
        assert pages - {"index"} == (named | further) - {""}


def test_a_plugin_from_elsewhere_is_on_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its page, to which a table would link, is not in docs/."""
    other = RegistryEntry("theirs:Policy", "of others", distribution="theirs-of-others")
    monkeypatch.setattr(reference, "entries", lambda kind: {**entries(kind), "theirs": other})
    assert "theirs" not in reference.own_entries("policies")
    assert "reference" in reference.own_entries("policies")
    assert not any("theirs" in row for row in generated.policies())
    assert any("slurm" in path for path in reference.help_pages())
    slurm = replace(entries("commands")["slurm"], distribution="theirs-of-others")
    monkeypatch.setattr(reference, "entries", lambda kind: {**entries(kind), "slurm": slurm})
    assert not any("slurm" in path for path in reference.help_pages())
    assert "#vlagents-ray-slurm" not in reference.commands()


@pytest.mark.parametrize(
    "part", ["run file", "deployment file", "settings of policies"], ids=lambda name: name
)
def test_each_setting_has_a_description(part: str) -> None:
    text = PARTS[part]()
    assert isinstance(text, str)
    rows = re.findall(r"^\| `.*$", text, re.MULTILINE)
    assert rows
    assert [row for row in rows if row.endswith("|  |")] == []


def test_each_setting_of_a_run_and_of_a_server_has_a_row() -> None:
    for model, prefix, text in (
        (EvalConfig, "", reference.run_file()),
        (ServerArgs, "args", reference.deployment_file()),
    ):
        for section, path in reference.sections(model, prefix):
            title = f"## `{path}`\n" if path else "## Top level\n"
            part = text.partition(title)[2].partition("\n## ")[0]
            keys = [field.alias or name for name, field in section.model_fields.items()]
            assert [key for key in keys if f"\n| `{key}` | " not in part] == [], path


def test_each_command_with_options_has_its_section() -> None:
    text = reference.commands()
    for path in reference.help_pages():
        assert path == "vlagents-ray" or f"## `{path}`\n" in text


def test_a_page_that_explains_a_setting_is_one_of_a_setting_that_exists() -> None:
    models: dict[str, type[BaseModel]] = {
        model.__name__: model
        for root in (EvalConfig, ServerArgs)
        for model, _ in reference.sections(root, "")
    }
    unknown = []
    for setting in reference.SEE:
        model, _, key = setting.partition(".")
        fields = models[model].model_fields if model in models else {}
        if key not in {field.alias or name for name, field in fields.items()}:
            unknown.append(setting)
    assert unknown == []
