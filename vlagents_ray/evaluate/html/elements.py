"""HTML out of Python calls: whatever is no `Html` yet is text, and is escaped."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

_VOID = frozenset({"img", "meta"})


class Html(str):
    """Text that is markup already."""

    __slots__ = ()


Child: TypeAlias = "Html | str | int | Iterable[Child] | None"
Attribute: TypeAlias = "str | float | bool | None"


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page with a heading that the table of contents leads to."""

    title: str
    content: Html

    @property
    def anchor(self) -> str:
        """The id of its heading."""
        return self.title.lower().replace(" ", "-")

    @property
    def html(self) -> Html:
        """Heading and content."""
        return tag("section", tag("h2", self.title, id=self.anchor), self.content, aria_labelledby=self.anchor)


def tag(name: str, /, *children: Child, **attributes: Attribute) -> Html:
    """`<name attribute="…">children</name>`; `class_` and `data_x` stand for `class` and `data-x`, None for no such."""
    words = [name, *(_attribute(key, value) for key, value in attributes.items() if value not in (None, False))]
    opening = f"<{' '.join(words)}>"
    return Html(opening if name in _VOID else f"{opening}{join(children)}</{name}>")


def join(children: Child) -> Html:
    """One after another."""
    if children is None:
        return Html("")
    if isinstance(children, Html):
        return children
    if isinstance(children, str | int):
        return Html(html.escape(str(children)))
    return Html("".join(join(child) for child in children))


def section(title: str, *children: Child) -> Section:
    """A section of the page."""
    return Section(title, join(children))


def fold(summary: Child, *children: Child, printed: bool = False) -> Html:
    """What is seen once its summary is clicked; on paper only if `printed`."""
    return tag("details", tag("summary", summary), *children, class_="printed" if printed else None)


def block(text: str) -> Html:
    """Text as it is, in lines, with a button that copies it."""
    return tag("div", tag("pre", tag("code", text), tabindex="0"), class_="block")


def table(head: Sequence[Child], rows: Iterable[Child], label: str, *, words: int = 1) -> Html:
    """A table that scrolls sideways where it is too wide; all but its first `words` columns hold numbers.

    `rows` are of `row`, or groups of them (`tbody`).
    """
    heads = [tag("th", one, scope="col", class_=None if i < words else "n") for i, one in enumerate(head)]
    inner = tag("table", tag("thead", tag("tr", heads)), rows)
    return tag("div", inner, class_="scroll", role="region", aria_label=label, tabindex="0")


def row(name: Child, *cells: Child, words: int = 1, class_: str | None = None) -> Html:
    """A row; the first cell is its heading, the others but the first `words - 1` are numbers."""
    rest = [tag("td", one, class_=None if i + 1 < words else "n") for i, one in enumerate(cells)]
    return tag("tr", tag("th", name, scope="row"), *rest, class_=class_)


def terms(pairs: Iterable[tuple[str, Child]]) -> Html:
    """Names and what they stand for."""
    return tag("dl", [(tag("dt", name), tag("dd", value)) for name, value in pairs])


def _attribute(key: str, value: Attribute) -> str:
    name = key.rstrip("_").replace("_", "-")
    if name == "viewbox":
        name = "viewBox"  # SVG's one name with a capital that is used here
    return name if value is True else f'{name}="{html.escape(_plain(value))}"'


def _plain(value: Attribute) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
