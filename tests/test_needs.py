"""Which files are imported follows from what is to run."""

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
    ],
)
def test_a_file_is_not_imported_if_all_of_it_is_left_out(
    line: str, markexpr: str, wanted: bool, tmp_path: Path
) -> None:
    file = tmp_path / "test_it.py"
    file.write_text(f"import pytest\n\n{line}\n")
    assert left_out(file, markexpr) is wanted
    assert not left_out(tmp_path, markexpr)
