"""Tests of the live page of an evaluation and of a training, in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from browser import Page, browser
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from live_server import Address
from recorded_results import record, runs

from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.report.results_document import ProgressDocument
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray_live.live_page import page_server
from vlagents_ray_live.live_view import Fleet

pytestmark = [pytest.mark.browser, pytest.mark.slow]

STATE = "document.getElementById('evaluation-state').textContent"
CARDS = "document.querySelectorAll('#failures article').length"
PLAYING = (
    "[...document.querySelectorAll('#failures video')].filter((one) => one.videoWidth === "
    "48).length"
)
UNFOLD = "document.getElementById('failures').closest('details').open = true"
SCROLL = "document.getElementById('failures').scrollIntoView()"
# Videos in view that are still being requested: a server that ends before it has sent them leaves
# their files open.
LOADING = (
    "[...document.querySelectorAll('#failures video:not([src])')].map((one) => "
    "one.getBoundingClientRect()).filter((box) => box.bottom > 0 && box.top < innerHeight).length"
)
POINTS = "document.querySelectorAll('#curve .dot').length"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of one policy, and another policy, with videos of failures, an error and a lost
    episode.
    """
    out = tmp_path_factory.mktemp("results") / "sweep"
    record(runs(out, episodes=5), videos=True, troubles=True)
    return out


@contextmanager
def served(
    read: Callable[[], dict[str, Any]], videos: Any = {}.get, keys: Keys | None = None
) -> Iterator[str]:
    """Yield the address of the page of this document."""
    with page_server(
        Fleet(None, extra=read), ("127.0.0.1", 0), keys, name="eval", videos=videos
    ) as url:
        yield url


def show(page: Page, url: str, *, width: int = 1400, scheme: str = "light") -> None:
    page.open(Address("about:blank"), width=width, scheme=scheme)  # type: ignore[arg-type]
    page.said.clear()  # messages of the previous page, whose server has ended
    page.asked.clear()
    page.open(Address(url), width=width, scheme=scheme)  # type: ignore[arg-type]


def until(page: Page, expression: str, want: object) -> None:
    wait_for(lambda: page.value(expression) == want, 30)


def begun(out: Path, **options: bool) -> ProgressDocument:
    """Return the document of a running evaluation."""
    document = ProgressDocument(out, **options)
    planned = plan_cases(runs(out, episodes=5))
    document.begin(planned, {}, sum(case.planned for case in planned))
    return document


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400, 3840])
def test_it_fits_without_errors_or_requests_outside(
    page: Page, results: Path, width: int, scheme: str
) -> None:
    document = begun(results)
    with served(document.read, document.video) as url:
        show(page, url, width=width, scheme=scheme)
        until(page, STATE, "Running")
        until(page, "document.querySelectorAll('#cases .case').length", 9)
        assert page.value("document.documentElement.scrollWidth") <= width
        assert page.value("document.querySelectorAll('.of-server:not([hidden])').length") == 0
        assert page.said == []
        own = f"{url.removesuffix('/live')}/"
        assert all(address.startswith(("blob:", "data:", own)) for address in page.asked)


def test_cases_fill_with_their_intervals_and_failures_come_with_video(
    page: Page, results: Path
) -> None:
    document = begun(results)
    with served(document.read, document.video) as url:
        show(page, url)
        until(page, f"{CARDS} >= 10", want=True)
        page.value(SCROLL)
        assert (
            page.value(f"{PLAYING} + document.querySelectorAll('#failures video[src]').length") == 0
        )
        page.value(UNFOLD)
        page.value(SCROLL)
        until(page, f"{PLAYING} >= 1", want=True)  # the videos in view
        until(page, LOADING, 0)
        controls = (
            "((video) => { const before = video.controls; video.click(); return [before, "
            "video.controls]; })"
        )
        assert page.value(f"{controls}(document.querySelector('#failures video'))") == [False, True]
        assert page.value(f"{PLAYING} < {CARDS} - 1")
        case = "document.querySelector('#cases .case').innerText"
        assert "5 of 5" in page.value(case)
        assert " to " in page.value(case)
        text = page.value("document.getElementById('failures').innerText")
        assert "lost to infrastructure" in text
        assert "error of the policy" in text
        assert "policy_failed: </script><img" in text  # shown as text
        until(page, POINTS, 2)
        assert "learner: " in page.value(
            "document.getElementById('curve').getAttribute('aria-label')"
        )
        assert page.said == []


def test_it_says_how_it_ends_and_keeps_what_was_seen(page: Page, results: Path) -> None:
    document = begun(results)
    with served(document.read, document.video) as url:
        show(page, url)
        until(page, STATE, "Running")
        document.fail("StorageFailed: the disk is full")
        until(page, STATE, "Stopped by an error: StorageFailed: the disk is full")
    until(page, "document.getElementById('connection').textContent", "Ended")
    assert page.value("document.querySelectorAll('#cases .case').length") == 9


def test_the_time_left_is_told(page: Page) -> None:
    said = begun(Path("none")).read()["evaluation"]
    with served(
        lambda: {"evaluation": said | {"done": 3, "planned": 12, "ends": time.time() + 600}}
    ) as url:
        show(page, url)
        until(
            page,
            "document.getElementById('episode-count').textContent",
            "3 of 12 episodes, about 10 min left",
        )


def test_videos_are_requested_with_the_key(page: Page, results: Path) -> None:
    keys = ChangingKeys()
    token = keys.add("watching", scopes=["watch"])
    document = begun(results)
    with served(document.read, document.video, keys.keys) as url:
        show(page, url)
        until(page, "document.getElementById('key').hidden", want=False)
        page.value(
            f"(() => {{ document.getElementById('key-text').value = '{token}';"
            "document.querySelector('#key button').click(); })()"
        )
        until(page, f"{CARDS} >= 10", want=True)
        page.value(UNFOLD)
        page.value(SCROLL)
        until(page, f"{PLAYING} >= 1", want=True)
        until(page, LOADING, 0)
