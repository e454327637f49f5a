"""Make the pictures of the live page and of the report: `python -m docs.pictures.screenshots`
serves the reference policy to two simulated robots, runs docs/evaluation/picture.yaml, and takes
pictures of both pages in the light and the dark colour scheme. The script needs Chromium.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from PIL import Image

from docs.pictures.demo import EXECUTE, POLICY, ROBOTS, ROOT, Robot, wait_for_cards
from tests.support.browser import Page, browser
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

EVALUATION = ROOT / "docs/evaluation"
SCHEMES = ("light", "dark")
REPORT = (1200, 900)  # px; size of each picture of the report
# Each part of the report, with the heading at its top.
PARTS = {
    "success": None,
    "comparison": "Comparison",
    "curve": "Learning curve",
    "failures": "Failures",
}
LIVE_WIDTH = 840  # px; at this width the live page shows two cards side by side
CALLS = 4  # calls of each robot before the picture of the live page is taken
# A video that has not been loaded shows a spinner.
_VIDEOS = """Promise.all([...document.querySelectorAll("video")].slice(0, 8).map((video) => {
  video.controls = false;
  video.preload = "auto";
  return new Promise((done) => {
    video.addEventListener("seeked", done);
    video.addEventListener("canplay", () => { video.currentTime = 1; }, {once: true});
    video.load();
  });
})).then(() => null)"""
_QUIET = "document.documentElement.style.scrollbarWidth = 'none'"


def photograph_live(page: Page) -> None:
    """Take a picture of the live page of a server with two robots."""
    with (
        running_server(deployment("reference", config=POLICY), num_cpus=2) as server,
        ExitStack() as stack,
    ):
        robots = [Robot(stack, server.url, task, ROBOTS[task]) for task in ("stack", "pick_place")]
        for scheme in SCHEMES:
            page.open(f"{server.url}/live", width=LIVE_WIDTH, height=900, scheme=scheme)
            wait_for_cards(page, len(robots))
            for _ in range(CALLS * EXECUTE):
                for robot in robots:
                    robot.step()
            page.value(f"{_QUIET}; new Promise((done) => setTimeout(done, 500))")
            height = page.value("document.body.scrollHeight")
            clip = {"x": 0, "y": 0, "width": LIVE_WIDTH, "height": height, "scale": 1}
            save(page.picture(clip), ROOT / f"docs/pictures/live-{scheme}.png")


def photograph_report(page: Page, report: Path) -> None:
    """Take pictures of three parts of a report."""
    width, height = REPORT
    for scheme in SCHEMES:
        page.open(report, width=width, height=height, scheme=scheme)
        page.value(_QUIET)
        page.value(_VIDEOS)
        for name, heading in PARTS.items():
            top = 0
            if heading is not None:
                top = page.value(
                    "[...document.querySelectorAll('h2')]"
                    f".find((one) => one.textContent === '{heading}')"
                    ".getBoundingClientRect().top + scrollY - 24"
                )
            page.value(f"scrollTo({{top: {top}, behavior: 'instant'}})")
            page.value("new Promise((done) => setTimeout(done, 500))")
            save(page.picture(), EVALUATION / f"report-{name}-{scheme}.png")


def save(png: bytes, file: Path) -> None:
    """Write a picture with a palette, which makes the file a third as large."""
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    picture.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3).save(file, optimize=True)


def evaluate(out: Path) -> None:
    """Run the evaluation of the report; its policy is in the folder EVALUATION."""
    command = [sys.executable, "-m", "vlagents_ray", "eval", "picture.yaml", "--out", str(out)]
    paths = filter(None, [str(EVALUATION), os.environ.get("PYTHONPATH")])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    # The command is this project's own.
    subprocess.run(command, check=True, cwd=EVALUATION, env=environment)  # noqa: S603


def main(
    run: Annotated[
        Path | None, typer.Option(help="Results of picture.yaml, if they are there already.")
    ] = None,
) -> None:
    """Take the pictures of the live page and of the report."""
    with tempfile.TemporaryDirectory() as name, browser(Path(name, "profile")) as page:
        if run is None:
            run = Path(name, "run")
            evaluate(run)
        photograph_report(page, run.resolve() / "report.html")
        photograph_live(page)


if __name__ == "__main__":
    typer.run(main)
