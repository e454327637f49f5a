"""The instructions of a Dockerfile."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Instruction:
    stage: str  # its name
    word: str  # in capitals: RUN
    flags: dict[str, str]  # --from=build: {"from": "build"}
    text: str  # the rest, on one line


def instructions(file: Path) -> Iterator[Instruction]:
    """In order, those before the first FROM in the stage ""; raises `ValueError` for a line that is none."""
    stage = ""
    kept = "\n".join(line for line in file.read_text().splitlines() if not line.lstrip().startswith("#"))
    for line in re.sub(r"\\\n", "", kept).splitlines():
        if not line.strip():
            continue
        match = re.fullmatch(r"([A-Z]+)((?:\s+--[\w-]+=\S+)*)\s+(.*)", line)
        if match is None:
            raise ValueError(f"{file}: {line!r} is no instruction")
        word, flags, text = match.groups()
        if word == "FROM":
            stage = text.rpartition(" AS ")[2]
        yield Instruction(stage, word, dict(re.findall(r"--([\w-]+)=(\S+)", flags)), text.strip())
