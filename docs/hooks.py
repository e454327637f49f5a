"""What the site needs beyond docs/: pages and files that stand elsewhere in the repository, at
their own paths.

Links are written as a checkout has them, so that they also work where the Markdown is read as it
is. On the site, docs/ is the root, and a link out of it leads to a copy of what it names.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = (
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "examples/README.md",
    "examples/experts/README.md",
    "tests/README.md",
)
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<path>(?!\w+:)[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_ABOVE_A_BLOCK = re.compile(r"^ *<!--(?:(?!-->).)*-->\n(?= *```)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages outside docs/, and every file outside docs/ that a page links to."""
    for name in PAGES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for file in list(files.documentation_pages()):
        for link in _LINK.finditer(file.content_string):
            path = _path(file.src_uri, link["path"])
            if (
                not path.startswith("docs/")
                and (ROOT / path).is_file()
                and path not in files.src_uris
            ):
                files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Leave out what is said to the tests, and turn links to where the site has what they name."""
    here = page.file.src_uri

    def turned(link: re.Match[str]) -> str:
        path = _path(here, link["path"])
        if (ROOT / path).is_dir():
            return link["text"]  # the site has no listings
        uri = posixpath.relpath(path.removeprefix("docs/"), posixpath.dirname(here) or ".")
        return f"[{link['text']}]({uri}{link['anchor'] or ''})"

    return _LINK.sub(turned, _ABOVE_A_BLOCK.sub("", markdown))


def on_nav(nav: Any, config: Any, files: Files) -> None:
    """Write llms.txt, which programs read that look something up for somebody: each page, and
    what it is about.
    """
    lines = [f"# {config['site_name']}", "", f"> {config['site_description']}"]
    for section in nav.items:
        lines += ["", f"## {section.title}", ""]
        lines += [_entry(page) for page in (section, *_pages(section)) if page.is_page]
    files.append(File.generated(config, "llms.txt", content="\n".join([*lines, ""])))


def _pages(section: Any) -> list[Any]:
    """The pages of a section, and those of the sections in it."""
    return [page for child in section.children or [] for page in (child, *_pages(child))]


def _entry(page: Any) -> str:
    """A page's line: its title, where it stands, and its first sentence, which a page in HTML
    does not have.
    """
    if not page.file.is_documentation_page():
        return f"- [{page.title}]({page.file.dest_uri})"
    title, _, rest = (
        re.sub(r"<!--.*?-->", "", page.file.content_string, flags=re.DOTALL)
        .lstrip("# \n")
        .partition("\n")
    )
    prose = next(
        (block for block in rest.split("\n\n") if re.match(r"\s*(?!```)[\w`*\[]", block)), ""
    )
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(prose.split()))
    about = re.split(r"(?<=\.) (?=[A-Z`])", plain)[0].removesuffix(":")
    return f"- [{title.strip()}]({page.file.dest_uri})" + (f": {about}" if about else "")


def _path(page: str, link: str) -> str:
    """The path in the repository of what a page of the site links to."""
    folder = posixpath.dirname(page if page in PAGES else f"docs/{page}")
    return posixpath.normpath(posixpath.join(folder, link))
