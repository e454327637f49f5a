"""RCS reads where its assets are when it is imported, and downloads what is not there."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from needs import assets
from rcs_stand_ins import write_duobench, write_rcs


@pytest.fixture(scope="session", autouse=True)
def _prefixes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """RCS's test assets with our stand-ins for what they lack, and stand-ins for DuoBench's."""
    source = assets("rcs")
    if source is None:  # the tests are skipped
        yield
        return
    folder = tmp_path_factory.mktemp("simulators")
    write_rcs(source, folder / "rcs")
    write_duobench(folder / "duobench")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RCS_PREFIX", str(folder / "rcs"))
        patch.setenv("DUOBENCH_PREFIX", str(folder / "duobench"))
        yield
