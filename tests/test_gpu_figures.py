"""Each figure in the docs that was measured on a GPU has its card, its date and its commit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
# On this page, each figure counts as measured on a GPU, even if no card is named.
GPU_PAGE = DOCS / "gpu.md"

CARD = re.compile(r"\b(?:A100|H100|H200|B200|L4|L40S?|RTX \w+)\b")
DATE = re.compile(r"\b20\d\d-\d\d-\d\d\b")
COMMIT = re.compile(r"\bcommit [0-9a-f]{8,12}\b")
FIGURE = re.compile(r"\d (?:ms|s|GB|MiB|GB/s|TFLOP/s|W|J|MHz|times)\b")
UNIT_OF_COLUMN = re.compile(
    r"\| (?:[^|\n]* )?(?:ms|s|GB|MiB|W|J per call|MHz|actions per second)(?: [^|\n]*)? \|"
)
# Phrases for figures that were not measured on a GPU.
OTHER = re.compile(r"\*\*(?:computed|counted)\*\*|\bas computed\b|\bon a CPU\b|\bCPU time\b")
# Links to the page with the card, the date and the commit.
LINK = re.compile(r"\]\((?:\.\./|docs/)*measured_gpu\.md\)")
# Durations and sizes that were not measured.
GIVEN = ("when no request has come for 5 s", "at 80 GB that is about")


def passages(text: str) -> list[str]:
    """Divide a text into paragraphs. A paragraph includes the list, table or code that it
    introduces, and a table includes the paragraph below it that names its origin.
    """
    paragraphs = re.split(r"\n\s*\n", text)
    joined: list[str] = []
    for paragraph in paragraphs:
        explains = paragraph.startswith("The table is **")
        if joined and (joined[-1].endswith(":") or explains):
            joined[-1] += f"\n\n{paragraph}"
        elif paragraph.strip():
            joined.append(paragraph)
    return joined


def has_figure(passage: str) -> bool:
    for given in GIVEN:
        passage = passage.replace(given, "")
    return bool(FIGURE.search(passage) or UNIT_OF_COLUMN.search(passage))


def lacks_origin(passage: str, *, is_of_gpu: bool) -> bool:
    """Return whether a passage has a figure of a GPU without its origin.

    Args:
        passage: The passage.
        is_of_gpu: Whether its figures are of a GPU even if it names no card.
    """
    names_card = bool(CARD.search(passage))
    if not has_figure(passage) or not (names_card or is_of_gpu):
        return False
    has_origin = names_card and DATE.search(passage) and COMMIT.search(passage)
    return not (has_origin or OTHER.search(passage) or LINK.search(passage))


def gpu_passages() -> list[str]:
    measured = DOCS / "measured_gpu.md"
    return [*passages(GPU_PAGE.read_text()), *passages(measured.read_text())]


def test_each_figure_of_a_gpu_names_its_card_its_date_and_its_commit() -> None:
    without = [passage for passage in gpu_passages() if lacks_origin(passage, is_of_gpu=True)]
    assert without == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_figures_of_a_card_on_other_pages_have_their_origin_or_a_link_to_it(page: Path) -> None:
    without = [
        passage for passage in passages(page.read_text()) if lacks_origin(passage, is_of_gpu=False)
    ]
    assert without == []


def test_the_pages_have_figures_of_a_gpu() -> None:
    measured = [
        passage for passage in gpu_passages() if has_figure(passage) and COMMIT.search(passage)
    ]
    assert len(measured) >= 3


TABLE = "π0 in CUDA graphs (NVIDIA H200, torch 2.11.0, 2026-11-26, commit 8a082135):\n\n| rows | act ms |\n| --- | --- |\n| 1 | 55.3 |"


@pytest.mark.parametrize("missing", ["H200", "2026-11-26", ", commit 8a082135"])
def test_a_table_without_a_part_of_its_origin_is_found(missing: str) -> None:
    [complete] = passages(TABLE)
    [incomplete] = passages(TABLE.replace(missing, ""))
    assert not lacks_origin(complete, is_of_gpu=True)
    assert lacks_origin(incomplete, is_of_gpu=True)


@pytest.mark.parametrize(
    ("text", "is_missing"),
    [
        ("An act took 53 ms.", True),
        ("An act takes 53 ms, as computed.", False),
        (
            "| option | memory |\n| --- | --- |\n| graphs | 0.3 GB |\n\nThe table is **computed**.",
            False,
        ),
        ("An act is 4.75 times as fast [there](measured_gpu.md).", False),
        ("The driver is 580 or newer.", False),
    ],
)
def test_a_sentence_needs_the_origin_of_what_was_measured_alone(
    text: str, is_missing: bool
) -> None:
    assert any(lacks_origin(passage, is_of_gpu=True) for passage in passages(text)) == is_missing
