"""Make the animated picture of the README: `python -m docs.pictures.demo` serves the reference
policy to four simulated robots, films the live page and one of the robots, evaluates the policy,
and writes demo.gif.

The policy receives images of 64 px, as in its training. The same actions are applied to a second
environment with the same seed, whose larger images are shown. The script needs Chromium, and
matplotlib for its fonts.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import typer
from PIL import Image, ImageColor, ImageDraw, ImageFont

from tests.support.browser import Page, browser
from vlagents_ray import Act, RemoteAgent
from vlagents_ray.envs import make_env
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

ROOT = Path(__file__).parents[2]
FILE = Path(__file__).with_name("demo.gif")
WIDTH, HEIGHT, CAPTION = 960, 540, 44  # px; CAPTION is the height of the line above the picture
LIVE = 560  # width of the live page in px; the scene takes the remaining width
PAGE_WIDTH = 840  # CSS px; at this width the live page shows two cards side by side
FRAME_MS = 110
FRAMES = 68
EXECUTE = 4  # executed rows of each chunk
# The settings of deployments/reference.yaml, but the policy returns all rows of a chunk. The path
# is relative to a checkout.
POLICY = {"checkpoint": "examples/reference/checkpoint", "embodiment": "tabletop"}
# task: seed; the first robot is filmed
ROBOTS = {"stack": 7, "pick_place": 3, "slide": 5, "lift": 11}
STILL_MS = 1900  # duration of the still of each part of the report
PAPER, INK, SOFT, ACCENT = "#ffffff", "#1b1f24", "#59636e", "#0060a8"
SERVE = ("Serve a policy to many robots", "vlagents-ray serve deployments/reference.yaml")
EVALUATE = ("Evaluate its checkpoints", "vlagents-ray eval examples/evaluations/compare.yaml")
_FONTS = ("DejaVuSans-Bold.ttf", "DejaVuSansMono.ttf", "DejaVuSans.ttf")


class Robot:
    """A simulated robot with a session. It begins a new episode when the previous one ends."""

    def __init__(
        self, stack: ExitStack, url: str, task: str, seed: int, side: int | None = None
    ) -> None:
        self.env = stack.enter_context(
            make_env(f"tabletop/{task}", cameras=["front", "wrist"], width=64, height=64)
        )
        self._shown = None
        if side is not None:
            self._shown = stack.enter_context(make_env(f"tabletop/{task}", width=side, height=side))
        self._agent = stack.enter_context(RemoteAgent(url, transport="websocket"))
        self._seed = seed
        self._pause = 0
        self.outcome = ""
        self._begin()

    def _begin(self) -> None:
        self._obs, _ = self.env.reset(seed=self._seed)
        self._agent.reset(self._obs, self.env.instruction, seed=self._seed)
        if self._shown is not None:
            self.picture = self._shown.reset(seed=self._seed)[0].cameras["front"]
        self._rows: list[np.ndarray] = []
        self.outcome = ""

    def step(self) -> None:
        """Run one step of the episode, or wait a second before the next episode."""
        if self.outcome:
            self._pause -= 1
            if self._pause <= 0:
                self._seed += 1
                self._begin()
            return
        if not self._rows:
            self._rows = list(self._agent.act(self._obs).rows()[:EXECUTE])
        act = Act(self._rows.pop(0))
        self._obs, _, terminated, truncated, info = self.env.step(act)
        if self._shown is not None:
            self.picture = self._shown.step(act)[0].cameras["front"]
        if info["success"] or terminated or truncated:
            self.outcome = "solved" if info["success"] else "not solved"
            self._pause = 10


def film(page: Page) -> Iterator[Image.Image]:
    """Yield frames that show the live page next to a robot."""
    served = deployment("reference", config=POLICY)
    side = WIDTH - LIVE - 24
    with running_server(served, num_cpus=2) as server, ExitStack() as stack:
        height = round((HEIGHT - CAPTION) * PAGE_WIDTH / LIVE)
        page.open(f"{server.url}/live", width=PAGE_WIDTH, height=height, scheme="light")
        robots = [
            Robot(stack, server.url, task, seed, side if index == 0 else None)
            for index, (task, seed) in enumerate(ROBOTS.items())
        ]
        wait_for_cards(page, len(robots))
        page.value(
            "document.querySelectorAll('#sessions details')"
            ".forEach((one) => { one.open = false; });"
            "document.documentElement.style.scrollbarWidth = 'none';"
            "document.getElementById('sessions').scrollIntoView()"
        )
        for _ in range(FRAMES):
            begun = time.monotonic()
            for robot in robots:
                robot.step()
            time.sleep(max(0.0, FRAME_MS / 1e3 - (time.monotonic() - begun)))
            yield _live_frame(_opened(page.picture()), robots[0])


def wait_for_cards(page: Page, number: int) -> None:
    """Wait until the live page shows `number` sessions."""
    cards = "document.querySelectorAll('#sessions article').length"
    limit = time.monotonic() + 30
    while page.value(cards) < number:
        if time.monotonic() > limit:
            raise TimeoutError(f"the live page shows {page.value(cards)} sessions")
        time.sleep(0.1)


def _live_frame(live: Image.Image, robot: Robot) -> Image.Image:
    frame = _captioned(*SERVE)
    area = (LIVE, HEIGHT - CAPTION)
    frame.paste(live.resize(area, Image.Resampling.LANCZOS), (0, CAPTION))
    scene = Image.fromarray(robot.picture)
    left, top = LIVE + 12, CAPTION + 66
    frame.paste(scene, (left, top))
    pen = ImageDraw.Draw(frame)
    words = textwrap.fill(robot.env.instruction or "", 32)
    pen.multiline_text((left, top - 8), words, INK, _font(0, 17), "ld")
    colour = "#1a7048" if robot.outcome == "solved" else SOFT
    state = robot.outcome or "10 Hz, 4 of the 8 actions of each chunk"
    pen.text((left, top + scene.height + 28), state, colour, _font(2, 16), "ls")
    return frame


def report_frames(page: Page, folder: Path) -> Iterator[Image.Image]:
    """Run an evaluation, and yield a frame for each part of its report."""
    command = [sys.executable, "-m", "vlagents_ray", "eval", "examples/evaluations/compare.yaml"]
    subprocess.run([*command, "--out", str(folder)], check=True, cwd=ROOT)  # noqa: S603
    height = HEIGHT - CAPTION
    page.open(folder / "report.html", width=WIDTH, height=height, scheme="light")
    page.value("document.documentElement.style.scrollbarWidth = 'none'")
    for title in ("h1", "h2"):  # the report's figures, then its table of success rates
        page.value(
            f"document.querySelector('{title}').scrollIntoView({{behavior: 'instant'}});"
            "scrollBy({top: -16, behavior: 'instant'})"
        )
        frame = _captioned(*EVALUATE)
        frame.paste(_opened(page.picture()), (0, CAPTION))
        yield frame


def _opened(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png)).convert("RGB")


def _captioned(title: str, command: str) -> Image.Image:
    """Return an empty frame with a title and a command above it."""
    frame = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    pen = ImageDraw.Draw(frame)
    pen.rectangle((0, 0, WIDTH, CAPTION - 1), INK)
    pen.text((14, CAPTION / 2), title, PAPER, _font(0, 18), "lm")
    pen.text((WIDTH - 14, CAPTION / 2), command, "#9fd0f5", _font(1, 16), "rm")
    return frame


def _font(kind: int, size: int) -> ImageFont.FreeTypeFont:
    from matplotlib import get_data_path

    return ImageFont.truetype(str(Path(get_data_path(), "fonts/ttf", _FONTS[kind])), size)


def write_gif(frames: Sequence[Image.Image], durations: Sequence[int], file: Path) -> None:
    """Write the frames with one palette. Unchanged pixels are transparent, which makes the file
    smaller.
    """
    samples = [np.asarray(frame.resize((WIDTH // 2, HEIGHT // 2))) for frame in frames[::10]]
    samples += [np.asarray(frame.resize((WIDTH // 2, HEIGHT // 2))) for frame in frames[-2:]]
    palette = Image.fromarray(np.concatenate(samples)).quantize(
        255, Image.Quantize.MEDIANCUT, kmeans=2
    )
    # The palette averages similar colours, which would tint the page's own colours: restore these.
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    for exact in map(ImageColor.getrgb, (PAPER, "#f6f7f9", INK)):
        colours[np.abs(colours - exact).sum(axis=1).argmin()] = exact
    palette.putpalette(colours.flatten().tolist())
    indices = [
        np.asarray(frame.quantize(palette=palette, dither=Image.Dither.NONE)) for frame in frames
    ]
    unchanged = 255
    pictures = []
    for number, index in enumerate(indices):
        shown = index if number == 0 else np.where(index == indices[number - 1], unchanged, index)
        picture = Image.fromarray(shown.astype(np.uint8), "P")
        picture.putpalette(palette.getpalette())
        pictures.append(picture)
    first, *rest = pictures
    first.save(
        file,
        save_all=True,
        append_images=rest,
        duration=list(durations),
        loop=0,
        disposal=1,
        transparency=unchanged,
        optimize=False,
    )


def main() -> None:
    """Write a GIF of the live page and of the report."""
    with tempfile.TemporaryDirectory() as name, browser(Path(name, "profile")) as page:
        frames = list(film(page))
        durations = [FRAME_MS] * len(frames)
        durations[-1] = 900
        stills = list(report_frames(page, Path(name, "compare")))
        frames += stills
        durations += [STILL_MS] * len(stills)
    write_gif(frames, durations, FILE)
    typer.echo(f"{FILE.name}: {sum(durations) / 1e3:.1f} s, {FILE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
