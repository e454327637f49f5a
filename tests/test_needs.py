"""Which files are imported follows from what is to run; the page of the tests knows what there is."""

from __future__ import annotations

from pathlib import Path

import pytest
from needs import left_out


@pytest.mark.parametrize(
    ("line", "markexpr", "wanted"),
    [
        ("pytestmark = pytest.mark.sim", "not (torch or sim)", True),
        ("pytestmark = [pytest.mark.vulkan, pytest.mark.slow]", "not (slow)", True),
        ("pytestmark = pytest.mark.simple", "not (torch or sim)", False),
        ("@pytest.mark.sim", "not (torch or sim)", False),
        ("pytestmark = pytest.mark.sim", "not (torch or sim) or slow", False),
        ("pytestmark = pytest.mark.sim", "slow", False),
        ("pytestmark = pytest.mark.sim", "", False),
        ("pytestmark = pytest.mark.hosts", "not (integration)", True),
        ("pytestmark = pytest.mark.hosts", "integration", False),
        ("@pytest.mark.integration", "integration", False),
        ("@pytest.mark.sim", "integration", True),
    ],
)
def test_a_file_is_not_imported_if_all_of_it_is_left_out(
    line: str, markexpr: str, wanted: bool, tmp_path: Path
) -> None:
    file = tmp_path / "test_it.py"
    file.write_text(f"import pytest\n\n{line}\n")
    assert left_out(file, markexpr) is wanted
    assert not left_out(tmp_path, markexpr)


def test_the_page_of_the_tests_lists_every_module_of_support() -> None:
    tests = Path(__file__).parent
    packages = {path.parent.name for path in (tests / "support").glob("*/__init__.py")}
    modules = {path.stem for path in (tests / "support").glob("*.py")} | packages
    page = (tests / "README.md").read_text()
    assert {name for name in modules if f"`{name}`" not in page and f"support/{name}.py" not in page} == set()
