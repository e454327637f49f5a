"""The site that `make docs` builds, opened by a browser from the file system."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin

import pytest
import reference
from browser import Page, browser
from eval_fakes import wait_for
from readme_blocks import options_of

from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.registry import entries
from vlagents_ray.serve.config.deployment import ServerArgs

ROOT = Path(__file__).parents[1]
SITE = ROOT / "build" / "docs"
PAGES = [
    "index.html",
    "tutorials/robot.html",
    "reference/index.html",
    "reference/evaluate.html",
    "troubleshooting.html",
    "measured.html",
    "ARCHITECTURE.html",
]
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(
        not (SITE / "index.html").is_file(), reason="the site is not built: make docs"
    ),
]


class PageLinks(HTMLParser):
    """The targets of a page's links, and its anchors."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: set[str] = set()
        self.anchors: set[str] = {""}
        self._page = page.as_uri()
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors.add(values.get("id") or "")
        if tag == "a" and values.get("href"):
            self.targets.add(urljoin(self._page, values["href"]))


def test_a_link_that_leads_nowhere_fails_the_build(tmp_path: Path) -> None:
    """The words after `mkdocs` are those of `make docs`: with --quiet, no warning would count."""
    pytest.importorskip("mkdocs")
    [words] = re.findall(r"bin/mkdocs (.+)", (ROOT / "Makefile").read_text())
    [validation] = re.findall(r"\nvalidation:\n(?:  .*\n)+", (ROOT / "mkdocs.yml").read_text())
    (tmp_path / "docs").mkdir()
    (tmp_path / "mkdocs.yml").write_text(f"site_name: a site{validation}")
    command = [sys.executable, "-m", "mkdocs", *words.split()]
    for link, leads_nowhere in (("index.md", False), ("nothing.md", True), ("#nothing", True)):
        (tmp_path / "docs/index.md").write_text(f"# Index\n\n[a page]({link})\n")
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert (done.returncode != 0) is leads_nowhere, done.stderr
        assert (f"'{link}'" in done.stderr) is leads_nowhere


def test_every_link_within_the_site_leads_to_a_file_and_an_anchor_in_it() -> None:
    # 404.html has links relative to a server's root.
    pages = {page: PageLinks(page) for page in SITE.rglob("*.html") if page.name != "404.html"}
    broken = set()
    for links in pages.values():
        for target in links.targets:
            url, anchor = urldefrag(target)
            path = Path(unquote(url.removeprefix("file://")))
            found = pages[path].anchors if path in pages else {anchor} if path.is_file() else set()
            if url.startswith("file:") and unquote(anchor) not in found:
                broken.add(target)
    assert sum(len(links.targets) for links in pages.values()) > len(pages)
    assert broken == set()


def text_of(page: str) -> str:
    """Return the text of a page of the site without tags, which are replaced by spaces."""
    return html.unescape(re.sub(r"<[^>]*>", " ", (SITE / page).read_text()))


def test_the_generated_parts_are_in_the_site() -> None:
    assert [
        str(page) for page in SITE.rglob("*.html") if "<!-- generated: " in page.read_text()
    ] == []
    for page, expected in (
        ("install.html", "spacemouse"),
        ("programs.html", "inspect-robots-franka"),
        ("policies/verification.html", "transformers 4.57.6"),
        ("policies/reference.html", "tabletop/pick_place"),
        ("evaluation/exports.html", "identifies the episode"),
    ):
        assert expected in text_of(page), page


def test_the_site_has_each_command_with_its_options() -> None:
    page = (SITE / "reference/cli.html").read_text()
    text = text_of("reference/cli.html")
    missing = []
    for path in reference.help_pages():
        if path == "vlagents-ray":
            continue
        if f'id="{path.replace(" ", "-")}"' not in page:
            missing.append(path)
        options = {option for option in options_of(path) if option.startswith("--")}
        for option in options - {"--help"}:
            if not re.search(rf"{option}(?![\w-])", text):
                missing.append(f"{path} {option}")
    assert missing == []


def test_the_site_has_each_setting_of_a_server_of_a_run_and_of_a_policy() -> None:
    missing = []
    for page, model in (("run_file", EvalConfig), ("deployment", ServerArgs)):
        text = (SITE / f"reference/{page}.html").read_text()
        for section, _ in reference.sections(model, ""):
            for name, field in section.model_fields.items():
                if f"<code>{field.alias or name}</code>" not in text:
                    missing.append(f"{page}: {field.alias or name}")
    text = text_of("reference/policies.html")
    for kind, noun in (("policies", "policy"), ("wrappers", "wrapper")):
        missing += [name for name in entries(kind) if f"{name} : {noun}" not in text]
    assert missing == []


def test_the_search_knows_the_generated_parts() -> None:
    index = (SITE / "search/search_index.js").read_text()
    for expected in (
        "reference/cli.html#vlagents-ray-serve",
        "reference/run_file.html#worker",
        "reference/deployment.html#argsbatch",
        "reference/policies.html#lerobot-policy",
        "inspect-robots-franka",
    ):
        assert expected in index, expected


def test_nothing_of_pythons_own_is_in_the_site() -> None:
    assert [str(path) for path in SITE.rglob("__pycache__")] == []


def test_llms_txt_names_each_page_of_the_navigation() -> None:
    listing = (SITE / "llms.txt").read_text()
    named = re.findall(r"^- \[.+?\]\((.+?)\)", listing, re.MULTILINE)
    pages = {page.relative_to(SITE).as_posix() for page in SITE.rglob("*.html")} - {"404.html"}
    assert listing.startswith("# vlagents_ray\n\n> ")
    assert set(named) == pages
    assert len(named) == len(pages)
    assert "- [LeRobot](policies/lerobot.html): The policy `lerobot` " in listing


# The number of lines of the module's path in the heading of a reference page.
LINES_OF_A_PATH = "document.querySelector('h1 code')?.getClientRects().length"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.mark.browser
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (360, "light")])
def test_pages_fit_and_ask_for_nothing_outside_of_the_site(
    page: Page, width: int, scheme: str
) -> None:
    page.asked.clear()
    page.said.clear()
    for name in PAGES:
        page.open(SITE / name, width=width, scheme=scheme)
        assert page.value("document.body.dataset.mdColorScheme") == (
            "slate" if scheme == "dark" else "default"
        )
        assert page.value("document.documentElement.scrollWidth") <= width, name
        assert page.value(LINES_OF_A_PATH) in (1, None), name
        assert (
            page.value("[...document.images].filter(one => !one.naturalWidth).map(one => one.src)")
            == []
        )
    assert [
        url for url in page.asked if not url.startswith((SITE.as_uri(), "data:", "blob:", "about:"))
    ] == []
    assert page.said == []


@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_pictures_of_the_report_have_the_readers_colours(page: Page, scheme: str) -> None:
    page.open(SITE / "evaluation/reading.html", width=1280, scheme=scheme)
    shown = "[...document.images].filter(one => one.naturalWidth).map(one => one.currentSrc)"
    parts = ("success", "comparison", "curve", "failures")
    assert page.value(shown) == [
        (SITE / "pictures/eval.svg").as_uri(),
        *((SITE / f"evaluation/report-{part}-{scheme}.png").as_uri() for part in parts),
    ]


@pytest.mark.browser
def test_the_search_finds_pages_without_a_server(page: Page) -> None:
    page.open(SITE / "index.html", width=1280, scheme="light")
    page.value('document.querySelector(".md-search__input").focus()')
    for letter in "watchdog":
        for event in ("keyDown", "keyUp"):
            page.call(
                "Input.dispatchKeyEvent",
                type=event,
                key=letter,
                **({"text": letter} if event == "keyDown" else {}),
            )
    found = '[...document.querySelectorAll(".md-search-result__link")].map(link => link.href)'
    wanted = (SITE / "control_loop.html").as_uri()
    # A match of the whole word.
    wait_for(lambda: any(link.startswith(wanted) for link in page.value(found)))
