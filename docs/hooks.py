"""What the site needs beyond docs/: pages and files that stand elsewhere in the repository, at their own paths.

Links are written as a checkout has them, so that they also work where the Markdown is read as it is. On the site, docs/
is the root, and a link out of it leads to a copy of what it names.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = ("ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
_LINK = re.compile(r"\[(?P<text>[^\]]*)\]\((?P<path>(?!\w+:)[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_ABOVE_A_BLOCK = re.compile(r"^ *<!--(?:(?!-->).)*-->\n(?= *```)", re.DOTALL | re.MULTILINE)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the repository's root, and every file outside docs/ that a page links to."""
    for name in PAGES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    for file in list(files.documentation_pages()):
        for link in _LINK.finditer(file.content_string):
            path = _path(file.src_uri, link["path"])
            if not path.startswith("docs/") and (ROOT / path).is_file() and path not in files.src_uris:
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


def _path(page: str, link: str) -> str:
    """The path in the repository of what a page of the site links to."""
    folder = posixpath.dirname(page if page in PAGES else f"docs/{page}")
    return posixpath.normpath(posixpath.join(folder, link))
