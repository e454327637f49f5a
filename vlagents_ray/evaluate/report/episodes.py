"""The sections of the page about episodes: a table of all episodes, videos of solved and unsolved
episodes, and errors.
"""

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
from vlagents_ray.images.mp4 import read_mp4
from vlagents_ray.protocol.messages import DEFAULT_LIMITS

BUDGET = 24 * 2**20  # maximum total size of the videos that a page embeds, bytes
POSTER = 224  # maximum side length of a poster, pixels
SMALL = 128  # a video with shorter sides, in pixels, is enlarged without blurring
MOST_UNSOLVED, MOST_SOLVED = 24, 12  # maximum number of videos of unsolved and of solved episodes
MOST_LISTED = 20_000  # maximum number of episodes in the table
# Number of rows that are visible when the page opens; the page's script shows more rows.
AT_ONCE = 500
MOST_ERRORS = 500
MOST_LOGS = 50
_OUTCOMES = {
    "success": "solved",
    "failure": "not solved",
    "policy_error": "policy error",
    "infra_failed": "lost",
}

CaseEpisode = tuple[CaseResults, Episode]  # an episode with its case


@dataclass(frozen=True, slots=True)
class Player:
    """A video on the page."""

    label: str
    source: str | None  # the URL of the video
    still: str | None  # the URL of the last frame; None if the file cannot be decoded
    style: str | None  # a class of the stylesheet
    tall: float | None  # height / width


Card = tuple[CaseResults, Episode, Player]  # an entry of a gallery


@dataclass(frozen=True, slots=True)
class EpisodeRow:
    """A row of the table of episodes."""

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
    all_count: bool  # whether the success rates include all episodes
    solved: list[Card]


@dataclass(frozen=True, slots=True)
class Failures:
    """The episodes that were not solved, some of them with a video."""

    unsolved: int
    cards: list[Card]
    inlined: int  # number of videos that the page embeds
    linked: int  # number of videos that the page links to
    outside: int  # number of videos that are omitted because they are links out of the folder


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of the policies, and failures of infrastructure."""

    of_policies: list[tuple[tuple[str, str, str], int]]  # ((policy id, task, error), episodes)
    # The first `MOST_LOGS` attempts that failed because of infrastructure.
    attempts: list[tuple[CaseResults, Attempt]]
    failed: int  # number of failed attempts
    repeated: int  # number of repeated attempts
    lost: int  # number of episodes without a result


class Gallery:
    """Chooses which videos the report embeds or links, within a size budget."""

    def __init__(self, results: Results, page: Path, *, inline: bool, budget: int = BUDGET) -> None:
        self._results, self._page = results, page
        self._budget = budget if inline else 0
        self.inlined = 0
        self.linked = 0
        # Paths that are symbolic links out of the folder of results, and are therefore not shown.
        self.outside: set[str] = set()

    def cards(self, episodes: Sequence[CaseEpisode], limit: int) -> list[Card]:
        """Return at most `limit` of these episodes, chosen in turn from the tasks and policies,
        among the episodes with a video.
        """
        by_case: dict[str, list[CaseEpisode]] = {}
        for case, episode in episodes:
            if episode.videos:
                by_case.setdefault(case.case_id, []).append((case, episode))
        rounds = itertools.zip_longest(*by_case.values())  # one episode from each case, or None

        cards: list[Card] = []
        for case, episode in filter(None, itertools.chain.from_iterable(rounds)):
            if len(cards) == limit:
                break
            label = f"{case.task}, episode {episode.result.key.episode}, {case.policy_id}"
            player = self.player(episode.videos[0], label)
            if player is not None:
                cards.append((case, episode, player))
        return cards

    def player(self, video: str, label: str) -> Player | None:
        """Return a player for the video at the path `video` of an episode; None if the file is
        missing.
        """
        path = self._file(video)
        if path is None:
            return None

        size = path.stat().st_size
        if size <= self._budget:
            self._budget -= size
            self.inlined += 1
            source: str | None = data_url("video/mp4", path.read_bytes())
        else:
            self.linked += 1
            source = self.link(video)

        frame = last_frame(path)
        if frame is None:
            return Player(label, source, still=None, style=None, tall=None)
        height, width = frame.shape[:2]
        style = "small" if max(height, width) < SMALL else None
        return Player(label, source, poster(frame), style, height / width)

    def link(self, video: str) -> str | None:
        """Return the page's link to a file; None if the file does not exist."""
        path = self._file(video)
        if path is None:
            return None
        relative = os.path.relpath(path, self._page.parent.resolve())
        return quote(Path(relative).as_posix())

    def _file(self, video: str) -> Path | None:
        try:
            path = self._results.file(video)
        except ConfigError:
            self.outside.add(video)
            return None
        return path if path.is_file() else None


def episodes(results: Results, gallery: Gallery) -> Episodes | None:
    """Return the view of all episodes; None if there are no episodes."""
    order = {name: index for index, name in enumerate(results.policy_ids)}
    cases = sorted(results.cases, key=lambda case: order[case.policy_id])
    played: list[CaseEpisode] = []
    for case in cases:
        played += [(case, episode) for episode in case.episodes]
    if not played:
        return None

    solved = []
    for case, episode in played:
        if episode.counts and episode.result.success_once:
            solved.append((case, episode))
    cards = gallery.cards(solved, MOST_SOLVED)
    rows = [_row(case, episode, gallery) for case, episode in played[:MOST_LISTED]]
    all_count = all(episode.counts for _, episode in played)
    return Episodes(rows, len(played) - len(rows), all_count, cards)


def _row(case: CaseResults, episode: Episode, gallery: Gallery) -> EpisodeRow:
    result = outcome(episode.result)
    words = f"({_OUTCOMES[result]})" if episode.beyond else _OUTCOMES[result]
    style = {"success": "good", "failure": None}.get(result, "bad")
    links = []
    for number, video in enumerate(episode.videos, 1):
        link = gallery.link(video)
        if link is not None:
            links.append((number, link))
    return EpisodeRow(case, episode, words, style, links)


def failures(results: Results, gallery: Gallery) -> Failures | None:
    """Return the view of the unsolved episodes; None if all were solved."""
    unsolved: list[CaseEpisode] = []
    for case in results.cases:
        for episode in case.episodes:
            if episode.counts and not episode.result.success_once:
                unsolved.append((case, episode))
    if not unsolved:
        return None
    cards = gallery.cards(unsolved, MOST_UNSOLVED)
    return Failures(len(unsolved), cards, gallery.inlined, gallery.linked, len(gallery.outside))


def errors(results: Results) -> Errors | None:
    """Return the view of the errors and their logs; None if there are no errors."""
    of_policies = errors_of_policies(results)
    attempts: list[tuple[CaseResults, Attempt]] = []
    for case in results.cases:
        attempts += [(case, attempt) for attempt in case.attempts]
    if not of_policies and not attempts:
        return None

    most_frequent_first = sorted(of_policies, key=lambda error: -error[1])
    return Errors(
        most_frequent_first[:MOST_ERRORS],
        attempts[:MOST_LOGS],
        failed=len(attempts),
        repeated=sum(attempt.retried for _, attempt in attempts),
        lost=sum(episode.result.status == "infra_failed" for episode in results.episodes),
    )


def last_frame(video: Path) -> np.ndarray | None:
    """Return the last frame, (H, W, 3) uint8 RGB; None if the file cannot be decoded."""
    try:
        with read_mp4(video, DEFAULT_LIMITS.pixels) as container:
            frames = collections.deque(container.decode(video=0), maxlen=1)
    except (OSError, ValueError):  # includes ConfigError, and PyAV's errors for broken files
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
