"""The report as a browser shows it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Page, browser
from recorded import record, runs

from vlagents_ray.evaluate.html import Videos, write_report

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module", params=["link", "inline"])
def report(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results")
    videos: Videos = request.param
    return write_report(record(runs(out), videos=True, troubles=True), out / "report.html", videos=videos)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400])
def test_it_fits_without_errors_or_requests(page: Page, report: Path, width: int, scheme: str) -> None:
    page.said.clear()
    page.asked.clear()
    page.open(report, width=width, scheme=scheme)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.said == []
    assert [address for address in page.asked if not address.startswith("data:")] == [report.as_uri()]
    assert page.value("document.querySelectorAll('h2').length") == 10
    light = page.value("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert light == (scheme == "light")


def test_its_videos_play(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="light")
    play = "(async (video) => { await video.play(); return video.videoWidth; })(document.querySelector('video'))"
    assert page.value(play) == 48


def test_the_gallery_shows_what_is_chosen(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="light")
    visible = "[...document.querySelectorAll('.gallery figure')].filter((card) => card.checkVisibility()).length"
    before = page.value(visible)
    page.value(
        "(() => { const select = document.querySelectorAll('.choices select')[1]; select.value = 'base';"
        "select.dispatchEvent(new Event('change', { bubbles: true })); })()"
    )
    assert 0 < page.value(visible) < before


def test_it_prints_with_its_settings_unfolded(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="dark")
    pages = len(re.findall(rb"/Type\s*/Page\b", page.pdf()))
    assert 2 <= pages <= 30
    page.value("dispatchEvent(new Event('beforeprint'))")
    assert page.value("document.querySelectorAll('details.printed:not([open])').length") == 0
    assert page.value("document.querySelectorAll('details:not([open])').length") > 0  # tracebacks, lists
