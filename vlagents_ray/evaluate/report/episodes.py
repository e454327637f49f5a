"""The episodes: a table of all, videos of solved and unsolved ones, and errors."""

from __future__ import annotations

import collections
import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.storage import outcome
from vlagents_ray.evaluate.results.reader import Attempt, CaseResults, Episode, Results
from vlagents_ray.evaluate.results.summary import errors_of_policies
from vlagents_ray.images.jpeg_png import data_url, encode_jpeg
from vlagents_ray.registry import require

BUDGET = 24 * 2**20  # bytes of videos that one page carries
POSTER = 224  # the most pixels of a poster's side
SMALL = 128  # a video whose sides have fewer pixels is enlarged without blurring
MOST_UNSOLVED, MOST_SOLVED = 24, 12  # videos
MOST_LISTED = 20_000  # episodes
AT_ONCE = 500  # rows when the page opens; its script shows more
MOST_ERRORS = 500
MOST_LOGS = 50
_OUTCOMES = {
    "success": "solved",
    "failure": "not solved",
    "policy_error": "policy error",
    "infra_failed": "lost",
}

Found = tuple[CaseResults, Episode]


@dataclass(frozen=True, slots=True)
class Player:
    """A video."""

    label: str
    source: str | None  # its URL
    still: str | None  # URL of its last frame; None: the file does not play
    style: str | None  # a class of the stylesheet
    tall: float | None  # height / width


Card = tuple[CaseResults, Episode, Player]  # of a gallery


@dataclass(frozen=True, slots=True)
class EpisodeRow:
    """An episode of the table."""

    case: CaseResults
    episode: Episode
    outcome: str
    style: str | None  # a class of the stylesheet
    videos: list[tuple[int, str]]  # (number, URL)


@dataclass(frozen=True, slots=True)
class Episodes:
    """All episodes, the first `MOST_LISTED` of them as rows."""

    rows: list[EpisodeRow]
    left_out: int
    all_count: bool  # in the rates
    solved: list[Card]


@dataclass(frozen=True, slots=True)
class Failures:
    """The episodes that were not solved, some of them with a video."""

    unsolved: int
    cards: list[Card]
    inlined: int  # videos in the page
    linked: int  # videos beside the page
    outside: int  # videos that are not shown, as they are symbolic links out of the folder


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of the policies, and failures of infrastructure."""

    of_policies: list[tuple[tuple[str, str, str], int]]  # ((policy id, task, error), episodes)
    # The first `MOST_LOGS` that failed by infrastructure.
    attempts: list[tuple[CaseResults, Attempt]]
    failed: int  # attempts
    repeated: int  # attempts
    lost: int  # episodes


class Gallery:
    """Chooses which videos the report embeds or links, within a size budget."""

    def __init__(self, results: Results, page: Path, *, inline: bool, budget: int = BUDGET) -> None:
        self._results, self._page = results, page
        self._budget = budget if inline else 0
        self.inlined = 0
        self.linked = 0
        # Paths that are symbolic links out of their folder of results: not shown.
        self.outside: set[str] = set()

    def cards(self, found: Sequence[Found], most: int) -> list[Card]:
        """Return at most `most` of these episodes with a video, from tasks and policies in
        turns.
        """
        by_case: dict[str, list[Found]] = {}
        for case, one in found:
            if one.videos:
                by_case.setdefault(case.case_id, []).append((case, one))
        drawn: list[Card] = []
        for case, one in filter(None, itertools.chain(*itertools.zip_longest(*by_case.values()))):
            label = f"{case.task}, episode {one.result.key.episode}, {case.contender}"
            if len(drawn) < most and (player := self.player(one.videos[0], label)) is not None:
                drawn.append((case, one, player))
        return drawn

    def player(self, video: str, label: str) -> Player | None:
        """Return a player for `video`, a path of an episode; None if the file is missing."""
        if (path := self._file(video)) is None:
            return None
        size, frame = path.stat().st_size, last_frame(path)
        if size <= self._budget:
            self._budget -= size
            self.inlined += 1
            source: str | None = data_url("video/mp4", path.read_bytes())
        else:
            self.linked += 1
            source = self.link(video)
        still = None if frame is None else poster(frame)
        style = "small" if frame is not None and max(frame.shape[:2]) < SMALL else None
        tall = None if frame is None else frame.shape[0] / frame.shape[1]
        return Player(label, source, still, style, tall)

    def link(self, video: str) -> str | None:
        """Return the page's link to the file; None without one."""
        path = self._file(video)
        return (
            None
            if path is None
            else quote(Path(os.path.relpath(path, self._page.parent.resolve())).as_posix())
        )

    def _file(self, video: str) -> Path | None:
        try:
            path = self._results.file(video)
        except ConfigError:
            self.outside.add(video)
            return None
        return path if path.is_file() else None


def episodes(results: Results, gallery: Gallery) -> Episodes | None:
    """Return all episodes, or None without any."""
    order = {name: index for index, name in enumerate(results.contenders)}
    cases = sorted(results.cases, key=lambda case: order[case.contender])
    if not (found := [(case, one) for case in cases for one in case.episodes]):
        return None
    solved = [(case, one) for case, one in found if one.counts and one.result.success_once]
    cards = gallery.cards(solved, MOST_SOLVED)
    rows = []
    for case, one in found[:MOST_LISTED]:
        kind = outcome(one.result)
        words = f"({_OUTCOMES[kind]})" if one.beyond else _OUTCOMES[kind]
        style = {"success": "good", "failure": None}.get(kind, "bad")
        links = [(number, gallery.link(video)) for number, video in enumerate(one.videos, 1)]
        rows.append(
            EpisodeRow(
                case,
                one,
                words,
                style,
                [(number, link) for number, link in links if link is not None],
            )
        )
    return Episodes(rows, len(found) - len(rows), all(one.counts for _, one in found), cards)


def failures(results: Results, gallery: Gallery) -> Failures | None:
    """Return the episodes that were not solved; None if there are none."""
    found = [
        (case, one)
        for case in results.cases
        for one in case.episodes
        if one.counts and not one.result.success_once
    ]
    if not found:
        return None
    cards = gallery.cards(found, MOST_UNSOLVED)
    return Failures(len(found), cards, gallery.inlined, gallery.linked, len(gallery.outside))


def errors(results: Results) -> Errors | None:
    """Return the errors with their logs; None without any."""
    broken = errors_of_policies(results)
    attempts = [(case, attempt) for case in results.cases for attempt in case.attempts]
    if not broken and not attempts:
        return None
    return Errors(
        sorted(broken, key=lambda one: -one[1])[:MOST_ERRORS],
        attempts[:MOST_LOGS],
        len(attempts),
        sum(attempt.retried for _, attempt in attempts),
        sum(one.result.status == "infra_failed" for case in results.cases for one in case.episodes),
    )


def last_frame(video: Path) -> np.ndarray | None:
    """Return the last frame, (H, W, 3) uint8 RGB; None if the file does not play."""
    av = require("av")
    try:
        with av.open(str(video)) as container:
            frames = collections.deque(container.decode(video=0), maxlen=1)
    except (OSError, ValueError):  # PyAV's errors of broken files are of these kinds
        return None
    return np.asarray(frames[0].to_ndarray(format="rgb24")) if frames else None


def poster(frame: np.ndarray) -> str:
    """Return a data: URL of `frame`, (H, W, 3) uint8 RGB, as a JPEG; a large frame is scaled
    down.
    """
    stride = -(-max(frame.shape[:2]) // POSTER)
    return data_url(
        "image/jpeg", encode_jpeg(np.ascontiguousarray(frame[::stride, ::stride]), quality=75)
    )
