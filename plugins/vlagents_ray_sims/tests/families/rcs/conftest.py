"""Sets the folders of RCS's assets: on import, RCS reads this setting, and downloads missing
assets.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from needs import assets
from rcs_stand_ins import write_duobench, write_rcs


@pytest.fixture(scope="session", autouse=True)
def _prefixes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Complete RCS's test assets with stand-ins, and replace DuoBench's assets with stand-ins."""
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
