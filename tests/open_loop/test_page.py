"""The page of an open-loop evaluation in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Page, browser

from vlagents_ray.open_loop.replay import ErrorTable, FrameError, OpenLoopResult
from vlagents_ray.open_loop.report import write_files

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven joints over a horizon of 50."""
    result = OpenLoopResult(
        ["/data/traces/one"], [f"joint_{i}" for i in range(7)], "answers", ErrorTable(7), sessions=1
    )
    for i in range(40):
        expected = np.sin((i + np.arange(50)[:, None]) / 10 + np.arange(7))
        got = expected + np.arange(50)[:, None] / 100
        result.frames.append(FrameError("one", 0, i, result.table.add(expected, got)))
        result.drawn.append((expected[0], got[0]))
    [_, path] = write_files(result, "candidate.yaml", tmp_path_factory.mktemp("report"))
    return path


@pytest.mark.parametrize(("width", "scheme"), [(360, "dark"), (1400, "light")])
def test_it_fits_and_asks_for_nothing(page: Page, file: Path, width: int, scheme: str) -> None:
    page.asked.clear()
    page.open(file, width=width, scheme=scheme)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.value("document.querySelectorAll('svg').length") == 8
    assert page.value("document.querySelectorAll('.map tbody td').length") == 7 * 50
    assert page.value("Array.from(document.querySelectorAll('svg path')).every(one => one.getBBox().width > 0)")
    assert page.asked == [file.as_uri()]
    assert page.said == []
