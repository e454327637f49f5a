"""cluster/docker/locks: images get what pyproject.toml and requirements/ want, and each package by its digest."""

from __future__ import annotations

import re

import pytest
import resolved
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = pytest.mark.integration

ENTRY = re.compile(r"([a-z0-9-]+)==(\S+)((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n")
TORCH = {Requirement(line).name: Requirement(line) for line in resolved.lines(resolved.TORCH)}


def locked(text: str) -> dict[str, str]:
    """The versions by name, of a lock that consists of a comment and of packages with digests."""
    comment, _, entries = text.partition("\n")
    assert comment.startswith("# ")
    assert ENTRY.sub("", entries) == "", "has a line that is neither a version nor a digest"
    return {name: version for name, version, _ in ENTRY.findall(entries)}


def unmet(versions: dict[str, str], requirements: list[str]) -> list[str]:
    """The requirements that no locked version meets."""
    wanted = [Requirement(text) for text in requirements]
    wanted = [TORCH.get(one.name, one) for one in wanted if one.marker is None or one.marker.evaluate()]
    return [
        str(one)
        for one in wanted
        if (version := versions.get(canonicalize_name(one.name))) is None or not one.specifier.contains(version)
    ]


def test_there_is_a_lock_for_every_image_and_no_other() -> None:
    assert {file.stem for file in resolved.LOCKS.iterdir()} == resolved.locks().keys()
    assert {"server-sim", "server-maniskill", "family-hf", "family-octo"} <= resolved.locks().keys()


@pytest.mark.parametrize("name", resolved.locks())
def test_a_lock_meets_what_its_image_wants_and_has_a_digest_of_every_package(name: str) -> None:
    python, requirements = resolved.locks()[name]
    text = (resolved.LOCKS / f"{name}.txt").read_text()
    assert f"for Python {python} on {resolved.PLATFORM}:" in text
    versions = locked(text)
    assert len(versions) > 60
    torch = [str(one) for name, one in TORCH.items() if name in versions]  # the same in all images
    assert unmet(versions, [*requirements, *torch]) == [], "run `make locks`"


def test_a_lock_that_is_out_of_date_or_has_no_digest_is_told() -> None:
    text = "# a comment\nnumpy==2.4.6 \\\n    --hash=sha256:" + 64 * "0" + "\n"
    assert locked(text) == {"numpy": "2.4.6"}
    assert unmet(locked(text), ["numpy>=1.24"]) == []
    assert unmet(locked(text), ["numpy>=2.5", "pillow>=10"]) == ["numpy>=2.5", "pillow>=10"]
    with pytest.raises(AssertionError, match="neither"):
        locked(text + "pillow==12.0\n")
