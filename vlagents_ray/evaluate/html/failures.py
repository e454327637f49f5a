"""What did not succeed: a gallery to look at, a list to go through, and what broke."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence

from vlagents_ray.evaluate.html.elements import Html, Section, block, fold, row, section, table, tag
from vlagents_ray.evaluate.html.numbers import count, moment
from vlagents_ray.evaluate.html.videos import Gallery
from vlagents_ray.evaluate.results import Attempt, CellResults, Episode, Results

MOST_CARDS = 24
MOST_LISTED = 500
MOST_LOGS = 50

Found = tuple[CellResults, Episode]


def failures(results: Results, gallery: Gallery) -> Section | None:
    """The episodes that were not solved, some of them with their videos; None if there are none."""
    found = [
        (cell, one) for cell in results.cells for one in cell.episodes if one.counts and not one.result.success_once
    ]
    if not found:
        return None
    drawn = (_card(cell, one, gallery) for cell, one in _in_turns(found))
    cards = list(itertools.islice(filter(None, drawn), MOST_CARDS))
    shown = f"Shown: {len(cards)} of {count(len(found), 'unsolved episode')}, taken from tasks and policies in turns."
    if gallery.inlined:
        shown += f" In this file: {count(gallery.inlined, 'video')}; beside it: {gallery.linked}."
    elif gallery.linked:
        shown += " Videos lie beside this file: keep them together."
    which = "All of" if len(found) <= MOST_LISTED else f"The first {MOST_LISTED} of"
    return section(
        "Failures",
        tag("p", shown if cards else f"{count(len(found), 'unsolved episode')}, none with a video.", class_="note"),
        tag("div", cards, class_="gallery") if cards else None,
        fold(f"{which} {count(len(found), 'unsolved episode')}", _list(found[:MOST_LISTED], gallery)),
    )


def errors(results: Results) -> Section | None:
    """Errors of the policies, and what infrastructure did, with the logs; None if there was nothing of either."""
    broken = [(cell, one) for cell in results.cells for one in cell.episodes if one.result.status == "policy_error"]
    attempts = [(cell, attempt) for cell in results.cells for attempt in cell.attempts]
    lost = sum(one.result.status == "infra_failed" for cell in results.cells for one in cell.episodes)
    if not broken and not attempts:
        return None
    return section(
        "Errors",
        tag("h3", "Of the policy"),
        _policy_errors(broken) if broken else tag("p", "None."),
        tag("h3", "Of infrastructure"),
        tag(
            "p",
            f"Failed: {count(len(attempts), 'attempt')}, of which {sum(one.retried for _, one in attempts)} repeated. "
            f"Lost, and in no rate: {count(lost, 'episode')}.",
        ),
        [_log(cell, attempt) for cell, attempt in attempts[:MOST_LOGS]],
        tag("p", f"{len(attempts) - MOST_LOGS} more are in results.db, table attempts.", class_="note")
        if len(attempts) > MOST_LOGS
        else None,
    )


def _in_turns(found: Sequence[Found]) -> Iterator[Found]:
    """One of each cell that has videos, then the second of each, and so on."""
    by_cell: dict[str, list[Found]] = {}
    for cell, one in found:
        if one.videos:
            by_cell.setdefault(cell.cell, []).append((cell, one))
    rounds = itertools.zip_longest(*by_cell.values())
    return (one for turn in rounds for one in turn if one is not None)


def _card(cell: CellResults, episode: Episode, gallery: Gallery) -> Html | None:
    result = episode.result
    name = f"{cell.env}, episode {result.key.episode}, {cell.contender}"
    shown = gallery.show(episode.videos[0], name)
    if shown is None:
        return None
    facts = [f"seed {result.key.seed}", f"{result.steps} steps", result.ending.replace("_", " ")]
    return tag(
        "figure",
        shown,
        tag(
            "figcaption",
            tag("strong", cell.env),
            tag("span", cell.contender),
            tag("span", f"“{result.instruction}”", class_="quote") if result.instruction else None,
            tag("span", ", ".join(facts)),
            tag("span", result.error, class_="bad") if result.error else None,
        ),
        data_env=cell.env,
        data_policy=cell.contender,
    )


def _list(found: Sequence[Found], gallery: Gallery) -> Html:
    rows = []
    for cell, one in found:
        links = [(gallery.link(video), f"video {number}") for number, video in enumerate(one.videos, 1)]
        shown = [(tag("a", text, href=link), " ") for link, text in links if link is not None]
        ending = one.result.error or one.result.ending.replace("_", " ")
        key = one.result.key
        rows.append(row(cell.env, cell.contender, ending, shown, key.episode, key.seed, one.result.steps, words=4))
    return table(["Task", "Policy", "Ended", "Videos", "Episode", "Seed", "Steps"], rows, "Unsolved episodes", words=4)


def _policy_errors(broken: Sequence[Found]) -> Html:
    counts = Counter((cell.contender, cell.env, one.result.error or "") for cell, one in broken)
    rows = [row(name, env, error, number, words=3) for (name, env, error), number in counts.most_common(MOST_LISTED)]
    return table(["Policy", "Task", "Error", "Episodes"], rows, "Errors of the policy", words=3)


def _log(cell: CellResults, attempt: Attempt) -> Html:
    then = "repeated" if attempt.retried else "given up"
    return fold(
        [
            tag("code", attempt.code),
            f" {cell.contender}, {cell.env}, attempt {attempt.attempt}, {then}: {attempt.error}",
        ],
        tag("p", f"{moment(attempt.at)}, {attempt.key}, blamed on the {attempt.cause}", class_="note"),
        block(attempt.traceback) if attempt.traceback else None,
    )
