"""What README and docs/ say about the registered adapters follows from the registry."""

from __future__ import annotations

import pytest
import tables

from vlagents_ray.registry import DIALECTS, ENVS, POLICIES


@pytest.mark.parametrize("file", [*tables.TABLES, "mkdocs.yml"])
def test_the_tables_are_up_to_date(file: str) -> None:
    text = (tables.ROOT / file).read_text()
    assert tables.with_tables(file, text) == text, "run `python tests/support/tables.py`"


def test_each_adapter_has_a_page_and_each_page_an_adapter() -> None:
    for folder, adapters, more in (("policies", POLICIES, tables.PLUGINS), ("benchmarks", ENVS, ())):
        named = {tables.page_of(name, one) for name, one in adapters.items() if one.about} | {*more}
        assert {page.stem for page in (tables.ROOT / "docs" / folder).glob("*.md")} - {"index"} == named - {""}


def test_each_dialect_is_shown_among_the_clients_of_other_systems() -> None:
    page = (tables.ROOT / "docs" / "other_clients.md").read_text()
    assert [name for name in DIALECTS if f"{name}: {{" not in page] == []
