"""The report in a browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Page, browser
from recorded_results import record, runs

from vlagents_ray.evaluate.report.page import write_report

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module", params=[False, True], ids=["link", "inline"])
def report(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results")
    return write_report(
        record(runs(out), videos=True, troubles=True), out / "report.html", inline=request.param
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400, 2560])
def test_it_fits_without_errors_or_requests(
    page: Page, report: Path, width: int, scheme: str
) -> None:
    page.said.clear()
    page.asked.clear()
    page.open(report, width=width, scheme=scheme)
    assert page.value("document.documentElement.scrollWidth") <= width
    assert page.said == []
    assert [address for address in page.asked if not address.startswith("data:")] == [
        report.as_uri()
    ]
    assert page.value("document.querySelectorAll('h2').length") == 10
    wall = page.value("getComputedStyle(document.documentElement).fontSize") == "22px"
    assert wall == (width > 2400)
    light = page.value("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert light == (scheme == "light")


def test_what_counts_is_in_sight_beside_its_policies_on_a_narrow_screen(
    page: Page, report: Path
) -> None:
    right = (
        "['success', 'comparison'].map((name) => document.querySelector(`#${name} ~ "
        ".scroll`)).every((frame) =>frame.querySelector('tr:last-child "
        "strong').getBoundingClientRect().right <= frame.getBoundingClientRect().right)"
    )
    names = (
        "[...document.querySelectorAll('#success ~ .scroll .over')].filter((row) => "
        "row.checkVisibility()).length"
    )
    for width in (360, 1400):
        page.open(report, width=width, scheme="light")
        assert page.value(right)
        assert (page.value(names) > 1) is (width == 360)
    page.open(report, width=768, scheme="light")
    hidden = (
        "((frame) => frame.scrollWidth - frame.clientWidth)(document.querySelector('#success "
        "~ .scroll'))"
    )
    assert page.value(hidden) == 0


def test_its_videos_play(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="light")
    play = (
        "(async (video) => { await video.play(); return video.videoWidth; "
        "})(document.querySelector('video'))"
    )
    assert page.value(play) == 48


EPISODES = (
    "[...document.querySelectorAll('.episodes tbody tr')].filter((row) => row.checkVisibility())"
)


def choose(page: Page, number: int, value: str) -> None:
    """Select a value in a filter of the table of episodes. The filters are 0: task, 1: policy, 2:
    outcome.
    """
    page.value(
        "(() => { const bar = document.querySelector('.episodes').previousElementSibling;"
        f"const select = bar.querySelectorAll('select')[{number}]; select.value = '{value}';"
        "select.dispatchEvent(new Event('change', { bubbles: true })); })()"
    )


def test_episodes_are_filtered_and_sorted(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="light")
    everything = page.value(f"{EPISODES}.length")
    choose(page, 1, "base")
    choose(page, 2, "solved")
    shown = page.value(
        f"{EPISODES}.map((row) => row.cells[1].textContent + row.cells[2].textContent)"
    )
    assert 0 < len(shown) < everything
    assert set(shown) == {"basesolved"}
    assert page.value("document.querySelector('output').value") == f"{len(shown)} of {everything}"
    seeds = f"{EPISODES}.map((row) => Number(row.cells[4].textContent))"
    for up in (True, False):
        page.value("document.querySelectorAll('.episodes .sort')[4].click()")
        assert page.value(seeds) == sorted(page.value(seeds), reverse=not up)


def test_many_episodes_are_shown_a_page_at_a_time_and_sorted_as_one(
    page: Page, tmp_path: Path
) -> None:
    results = record(runs(tmp_path, steps=[1000], episodes=140))  # 840 episodes in total
    page.open(write_report(results, tmp_path / "report.html"), width=1400, scheme="light")
    assert page.value(f"{EPISODES}.length") == 500
    page.value("document.querySelectorAll('.episodes .sort')[4].click()")
    page.value("document.querySelectorAll('.episodes .sort')[4].click()")
    assert page.value(f"{EPISODES}[0].cells[4].textContent") == "139"
    assert page.value(f"{EPISODES}.length") == 500
    choose(page, 1, "base")
    assert page.value(f"{EPISODES}.length") == 420
    choose(page, 1, "")
    page.value("document.querySelector('.episodes + button').click()")
    assert page.value(f"{EPISODES}.length") == 840


def test_videos_of_the_table_play_one_after_another(page: Page, report: Path) -> None:
    page.asked.clear()
    page.open(report, width=1400, scheme="light")
    choose(page, 2, "not solved")
    page.value(f"{EPISODES}[0].querySelector('a.video').click()")
    playing = "document.querySelector('.viewer video').currentSrc"
    words = "document.querySelector('.viewer p').textContent"
    ready = (
        "new Promise((done) => { const video = document.querySelector('.viewer video');const look "
        "= () => video.currentSrc === video.src && video.videoWidth && video.style.height "
        "?done([video.videoWidth, video.clientWidth * video.videoHeight / video.videoWidth - "
        "video.clientHeight]) :setTimeout(look, 20); look(); })"
    )
    width, below = page.value(ready)
    assert width == 48
    assert below <= -50  # px below the picture that stay free for the controls
    first, said = page.value(playing), page.value(words)
    page.value("document.querySelectorAll('.viewer button')[1].click()")
    page.value(ready)
    assert page.value(words) != said
    assert "not solved" in page.value(words)
    page.value("document.querySelectorAll('.viewer button')[0].click()")
    page.value(ready)
    assert (page.value(playing), page.value(words)) == (first, said)
    page.value("document.querySelectorAll('.viewer button')[2].click()")
    assert page.value("document.querySelector('.viewer').open") is False
    assert page.asked[0] == report.as_uri()


def test_it_prints_with_its_settings_unfolded(page: Page, report: Path) -> None:
    page.open(report, width=1400, scheme="dark")
    pages = len(re.findall(rb"/Type\s*/Page\b", page.pdf()))
    assert 2 <= pages <= 30
    page.value("dispatchEvent(new Event('beforeprint'))")
    assert page.value("document.querySelectorAll('details.printed:not([open])').length") == 0
    # tracebacks and lists stay folded
    assert page.value("document.querySelectorAll('details:not([open])').length") > 0
