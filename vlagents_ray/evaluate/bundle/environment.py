"""The software of a bundle beside that of this machine, and the weights that its episodes were played by."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from vlagents_ray.evaluate.artifacts.provenance import versions
from vlagents_ray.evaluate.bundle.finding import Finding
from vlagents_ray.evaluate.bundle.packages import compared, pins, versions_of
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.evaluate.results.summary import checkpoint_of, pushed_of, weights_of

_RUN_PACKAGES = ("vlagents-ray", "ray", "numpy", "av")  # those that `versions` names
_SHOWN = 8


def same_software(written_by: dict[str, Any]) -> bool:
    """Whether the versions that wrote a bundle are those here: Python, packages and code."""
    here = versions()
    return all(_plain(written_by.get(name)) == _plain(here[name]) for name in ("python", *_RUN_PACKAGES)) and (
        _commit(written_by) == _commit(here)
    )


def check_versions(results: Results) -> Iterator[Finding]:
    """Compare what the last run was made with to what is here."""
    there, here = results.runs[-1].versions, versions()
    odd = [
        f"{name} {there.get(name)} there, {here[name]} here"
        for name in ("python", "platform", *_RUN_PACKAGES)
        if there.get(name) != here[name]
    ]
    if odd:
        yield Finding("versions", "other here", "; ".join(odd))
    else:
        yield Finding("versions", "equal", f"Python {here['python']}, {', '.join(_RUN_PACKAGES)} and the platform")
    was, now = _commit(there), _commit(here)
    if was[0] is None or now[0] is None:
        where = "there" if was[0] is None else "here"
        yield Finding("code", "not checked", f"vlagents-ray has no git commit {where}: it is an installed package")
    elif was == now:
        yield Finding("code", "equal", f"vlagents-ray at commit {was[0]}")
    else:
        yield Finding("code", "other here", f"vlagents-ray at commit {_text(was)} there, {_text(now)} here")


def check_packages(lock: str, results: Results) -> Iterator[Finding]:
    """Compare the bundle's lock with the run that it is to be the lock of, and with the packages here."""
    there = versions_of(lock)
    run = {name: results.runs[-1].versions.get(name) for name in _RUN_PACKAGES}
    strange = [
        f"{name} {there[name]} in the lock, {run[name]} in the run"
        for name in _RUN_PACKAGES
        if name in there and run[name] not in (None, there[name])
    ]
    if strange:
        yield Finding("packages.txt", "other here", f"of another environment than the run's: {'; '.join(strange)}")
    same, odd = compared(there, versions_of(pins()))
    if odd:
        more = f"; and {len(odd) - _SHOWN} more" if len(odd) > _SHOWN else ""
        yield Finding("packages", "other here", f"{same} of {len(there)} are here; {'; '.join(odd[:_SHOWN])}{more}")
    else:
        yield Finding("packages", "equal", f"all {len(there)} are here in these versions")


def check_weights(results: Results) -> Iterator[Finding]:
    """Say which weights the episodes were played by: a bundle holds none, so that nothing is checked."""
    for contender in results.contenders:
        cells = results.of(contender)
        named = [one for cell in cells for one in (checkpoint_of(cell), weights_of(cell), pushed_of(cell)) if one]
        said = ", ".join(dict.fromkeys(named)) or "no server reported any"
        yield Finding(f"weights of {contender}", "not checked", f"{said}; a bundle holds no weights")


def _commit(found: dict[str, Any]) -> tuple[str | None, str | None]:
    code = found.get("code")
    state = code.get("vlagents_ray") if isinstance(code, dict) else None
    return (state.get("commit"), state.get("diff_sha256")) if isinstance(state, dict) else (None, None)


def _text(commit: tuple[str | None, str | None]) -> str:
    return f"{commit[0]} with changes" if commit[1] else f"{commit[0]}"


def _plain(version: object) -> str:
    return re.sub(r"\s+", "", str(version))
