"""The README's benchmark section, from the figures alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vlagents_ray.bench.targets import Outcome, outcomes
from vlagents_ray.errors import ConfigError

BEGIN, END = "<!-- bench -->", "<!-- /bench -->"
_MET = {True: "yes", False: "**no**", None: ""}


def replaced(text: str, section: str) -> str:
    """`text` with `section` between its two markers. Raises `ConfigError` unless it has both, once."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or BEGIN in after or END in before + after:
        raise ConfigError(f"the README has no single pair {BEGIN} … {END}; put it where the figures belong")
    return f"{before}{BEGIN}\n{section.strip()}\n{END}{after}"


def section(results: Mapping[str, Any]) -> str:
    """What stands between the markers: targets, round trips, the link, throughput, and where all that comes from."""
    parts = [_origin(results), _targets(outcomes(results))]
    if rtt := results.get("rtt"):
        parts.append(_round_trips("Round trips of one `act` on one machine", rtt))
    if link := results.get("link"):
        name = (
            f"The same over a link of {link['link']['measured_mbit_per_s']:.0f} Mbit/s between two network namespaces"
        )
        parts.append(_round_trips(name, link))
    if throughput := results.get("throughput"):
        parts.append(_throughput(throughput))
    if skipped := list(_skipped(results)):
        parts.append("Not measured: " + "; ".join(skipped) + ".")
    return "\n\n".join(parts)


def _origin(results: Mapping[str, Any]) -> str:
    machine = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    return (
        f"Measured {results['date']} by `{results['command']}` on {machine['cpu']}, {machine['cores']} cores, "
        f"{machine['memory_gb']} GB, Linux {machine['kernel']}, load average {machine['load']:.1f} before it began. "
        f"{versions}. Two 224x224 RGB cameras, a policy that does nothing, all ways in turns of 100 calls in one run; "
        f"in brackets 95 % intervals. A turn begins cold, which is most of what the p99 column shows."
    )


def _targets(lines: Sequence[Outcome]) -> str:
    return _table(
        ("", "wanted", "measured", "met"), [(one.what, one.wanted, one.measured, _MET[one.met]) for one in lines]
    )


def _round_trips(title: str, part: Mapping[str, Any]) -> str:
    theirs = [peer["way"] for peer in part["peers"]]
    rows = []
    for way in sorted([*part["ways"], *part["peers"]], key=lambda one: float(one["median_ms"])):
        low, high = way["ci95_ms"]
        ratios = part["ratios"].get(way["way"], {})
        name = f"*{way['way']}*" if way["way"] in theirs else way["way"]
        rows.append(
            (
                name,
                f"{way['median_ms']:.3f} ({low:.3f} to {high:.3f})",
                f"{way['p99_ms']:.2f}",
                *(f"{ratios[peer]['ratio']:.2f}" if peer in ratios else "" for peer in theirs),
            )
        )
    return f"{title}:\n\n" + _table(("", "median ms", "p99 ms", *(f"/ {peer}" for peer in theirs)), rows)


def _throughput(part: Mapping[str, Any]) -> str:
    counts = [point["clients"] for row in part["transports"].values() for point in row["curve"]]
    counts = list(dict.fromkeys(counts))
    head = (
        "",
        f"of the ideal, {part['clients']} clients",
        *(f"K = {k}" for k in counts),
        "a robot waits, p50 / p99 ms",
    )
    rows = []
    for name, row in part["transports"].items():
        curve = {point["clients"]: point for point in row["curve"]}
        robot = row["robot"]
        waits = f"{robot['wait_p50_ms']:.1f} / {robot['wait_p99_ms']:.1f}" if robot else ""
        rates = [f"{curve[k]['actions_per_s']:.0f}" if k in curve else "" for k in counts]
        rows.append((name, f"{row['of_ideal']:.3f}", *rates, waits))
    what = f"`{part['policy']}`" + "".join(f", {key} {value}" for key, value in part["config"].items())
    text = (
        f"Actions a second of one replica by K clients ({what}, batches of {part['batch']} at most; ideal "
        f"{part['ideal_actions_per_s']:.0f}, {part['ideal_is']}), and what a robot among simulations waits:"
    )
    return f"{text}\n\n{_table(head, rows)}"


def _skipped(results: Mapping[str, Any]) -> Iterator[str]:
    for name, reason in (results.get("skipped") or {}).items():
        yield f"{name} ({reason})"
    found: dict[str, str] = {}
    for part in ("rtt", "link", "throughput", "evaluation"):
        found |= (results.get(part) or {}).get("skipped", {})
    for name, reason in found.items():
        yield f"{name} ({reason})"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
