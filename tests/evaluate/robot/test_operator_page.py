"""The operator's page in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import Page, browser
from eval_fakes import wait_for
from robot_trials import NAMES, Arm, Evaluation, plan, tasks

from vlagents_ray.evaluate.robot import PageOperator

pytestmark = [pytest.mark.browser, pytest.mark.slow]

PHASE = "document.getElementById('phase').textContent"
LIVE = (
    "[...document.querySelectorAll('figure img')].filter((one) => one.naturalWidth === 32 && "
    "!one.hidden).length"
)
CLICK = "document.querySelector('[data-do={}]').click()"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def until(page: Page, expression: str, want: object) -> None:
    wait_for(lambda: page.value(expression) == want, 30)


def require_tidy(page: Page, width: int) -> None:
    """Check that the page fits the window, and that it does not contain a policy's name."""
    assert page.value("document.documentElement.scrollWidth") <= width
    text = page.value("document.documentElement.outerHTML")
    assert not any(name in text for name in NAMES)


@pytest.mark.parametrize(("width", "scheme"), [(360, "light"), (1400, "dark")])
def test_a_scene_is_set_played_and_judged(
    page: Page, tmp_path: Path, width: int, scheme: str
) -> None:
    page.said.clear()
    page.asked.clear()
    config = plan(
        tmp_path / "out", suite={"episodes": 1}, robot={"tasks": tasks(max_steps=200 * 60)}
    )
    with PageOperator(say=lambda _: None) as operator:
        run = Evaluation(config, operator, Arm())
        page.open(operator.url, width=width, scheme=scheme)
        for number in range(1, 5):
            until(page, "document.title", f"Trial {number} of 4")
            until(page, PHASE, "Set the scene")
            until(page, LIVE, 1 if number % 2 else 2)
            if not number % 2:
                page.value("document.getElementById('opacity').value = 20")
                until(page, "[...document.querySelectorAll('figure img')][1].style.opacity", "0.2")
            require_tidy(page, width)
            assert page.value(
                "document.querySelector('[data-do=ready]').getBoundingClientRect().bottom <= "
                "innerHeight"
            )
            page.value(CLICK.format("ready"))
            if number > 2:
                until(page, PHASE, "Running")
                until(page, "document.activeElement.dataset.do", "stop")
                page.value(CLICK.format("stop"))
            until(page, PHASE, "Your verdict")
            require_tidy(page, width)
            page.value(CLICK.format("repeat"))
            until(
                page,
                "document.getElementById('error').textContent.includes('expected a reason for the repetition')",
                want=True,
            )
            if number < 3:
                page.value("document.querySelector('#parts input').click()")
            page.value(CLICK.format("partial" if number < 3 else "failure"))
        run.join()
    assert run.error is None
    assert run.summary is not None
    assert run.summary.total.mean_return == pytest.approx(0.125)
    until(page, PHASE, "The evaluation is complete: close this page")
    until(
        page,
        "document.querySelectorAll('button').length - document.querySelectorAll('#answers[hidden] "
        "button').length",
        0,
    )
    require_tidy(page, width)
    outside = [url for url in page.asked if not url.startswith((operator.url, "data:"))]
    assert outside == []
    said = [one for one in page.said if "400" not in one]
    # The page may request one more image while the evaluation ends, and with it the page's server.
    said = [one for one in said if not ("/now/camera/" in one and "ERR_CONNECTION_REFUSED" in one)]
    assert said == [], "the page must report no errors other than the rejected answers"
