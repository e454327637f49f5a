"""The security headers of every served page, and the content policy of pages that are files."""

from __future__ import annotations

import base64
import hashlib
import re
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from live_server import live_server

import vlagents_ray
from vlagents_ray.evaluate.robot.operator import PageOperator
from vlagents_ray_live.live_page import page_server
from vlagents_ray_live.live_view import Fleet

PACKAGE = Path(vlagents_ray.__file__).parent
# All modules that send HTML.
SERVES = {"evaluate/robot/operator.py", "serve/endpoints/http_messages.py"}


@contextmanager
def on_a_server(path: str) -> Iterator[str]:
    with live_server() as server:
        yield f"{server.url}{path}"


@contextmanager
def of_an_evaluation() -> Iterator[str]:
    with page_server(Fleet(None), ("127.0.0.1", 0), None, name="eval", videos={}.get) as url:
        yield url


@contextmanager
def of_the_operator() -> Iterator[str]:
    with PageOperator(lambda _: None) as operator:
        yield operator.url


PAGES = {
    "live page of a server": lambda: on_a_server("/live"),
    "live page of an evaluation": of_an_evaluation,
    "docs of a server": lambda: on_a_server("/docs"),
    "operator's page": of_the_operator,
}


def directives(policy: str) -> dict[str, str]:
    return {
        name: sources
        for name, _, sources in (one.strip().partition(" ") for one in policy.split(";"))
    }


def digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_its_own_scripts_alone_and_no_other_site_frames_it(page: str) -> None:
    with PAGES[page]() as url, urllib.request.urlopen(url, timeout=30) as answer:
        headers, html = answer.headers, answer.read().decode()
    policy = directives(headers["content-security-policy"])
    for name in ("default-src", "base-uri", "form-action", "frame-ancestors"):
        assert policy[name] == "'none'", name
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["content-type"].startswith("text/html")
    for kind in ("script", "style"):
        for text in re.findall(rf"<{kind}>(.*?)</{kind}>", html, re.DOTALL):
            assert digest(text) in policy[f"{kind}-src"]


def test_no_other_module_sends_html() -> None:
    sends = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if re.search(r"HTMLResponse|text/html", path.read_text())
    }
    assert sends == SERVES


def test_pages_that_are_files_load_nothing_from_elsewhere() -> None:
    """Browsers accept `frame-ancestors` only in headers, which a file does not have."""
    templates = [
        path for path in PACKAGE.rglob("*.j2") if "<!doctype html>" in path.read_text().lower()
    ]
    for path in templates:
        [policy] = re.findall(
            r'<meta http-equiv="Content-Security-Policy" content="(.*?)">', path.read_text()
        )
        assert directives(policy)["default-src"] == "'none'", path
        assert "http" not in policy, path
