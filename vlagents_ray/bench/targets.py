"""What the measurements must show, and whether they do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Results = Mapping[str, Any]  # of `vlagents_ray.bench.report.collect`

ON_NODE = ("plasma, Ray actor", "shm, Ray actor")  # the faster one first
DEFAULT, JPEG = "websocket, default", "websocket, jpeg"
LIMIT_P99 = 3.0
LIMIT_WAIT_MS = 72.0  # two full batches of 20 ms + 16 x 1 ms
LIMIT_VLA_EVAL = 1.3
LIMIT_GAP_MS = 5.0
LIMIT_SLOWDOWN = 1.25  # of the last thousand episodes against the first, noise included
LIMIT_GROWTH_MIB = 0.5  # of a process in a thousand episodes


@dataclass(frozen=True, slots=True)
class Outcome:
    """One line of the table."""

    what: str
    wanted: str
    measured: str
    met: bool | None  # None: not measured


def outcomes(results: Results) -> list[Outcome]:
    """Every target, in order, with what was measured."""
    rtt, link = results.get("rtt") or {}, results.get("link") or {}
    actor = next((name for name in ON_NODE if name in rtt.get("ratios", {})), ON_NODE[0])
    node, shm = "a Ray env actor and the replica on its node", "a local process and the replica"
    return [
        _ratio(rtt, f"{node} ({actor.partition(',')[0]})", actor, "vlagents shm", 0.40),
        _ratio(rtt, f"{shm} (shm)", "shm", "vlagents shm", 0.20),
        _ratio(rtt, f"{shm} (shm)", "shm", "openpi", 0.20),
        _ratio(rtt, "WebSocket, JPEG at vlagents' setting (q85 4:4:4)", JPEG, "vlagents JPEG", 0.62),
        _default(rtt),
        _ratio(rtt, "HTTP, JPEG", "http, jpeg", "vlagents JPEG", 1.0),
        _ratio(rtt, "HTTP, JPEG", "http, jpeg", "OpenVLA REST", 0.60),
        _ratio(link, "WebSocket, our default, over the link", DEFAULT, "vlagents JPEG", 0.50),
        _ratio(link, "WebSocket, our default, over the link", DEFAULT, "openpi", 0.45),
        *(_tail(rtt, name) for name in dict.fromkeys([actor, "shm"])),
        *_throughput(results.get("throughput") or {}),
        *(evaluation_outcomes(results["evaluation"]) if "evaluation" in results else []),
    ]


def evaluation_outcomes(found: Results) -> list[Outcome]:
    """Of `vlagents_ray.bench.evaluation.measure_evaluation`: against a peer's one process, all cores must count."""
    workers = found["plan"]["workers"]
    cores = min(found["cores"], workers)
    limits = {"vlagents": float(cores), "vlagents, split": 1.0, "vla-eval": LIMIT_VLA_EVAL}
    names = {
        "vlagents": "vlagents run-eval, one process",
        "vlagents, split": f"vlagents run-eval, {workers} processes and servers",
        "vla-eval": f"vla-eval, {workers} shards",
    }
    return [
        Outcome(
            f"episodes a minute of whole evaluations, {workers} workers",
            f"≥ {limits[name]:g} x {names[name]}",
            f"{row['median']:.2f}",
            row["median"] >= limits[name],
        )
        for name, row in found["ratios"].items()
    ]


def soak_outcomes(found: Results) -> list[Outcome]:
    """Of `vlagents_ray.bench.soak.measure_soak`."""
    episodes, gap, cpu = found["plan"]["episodes"], found["gap_ms"], found["driver_cpu_ms"]
    first, last = gap["first"]["median"], gap["last"]["median"]
    slowdown = cpu["last"] / cpu["first"]
    once = f"{found['done']} done, {'each key once' if found['keys_once'] else 'not each key once'}"
    return [
        Outcome(
            "every episode", f"{episodes} done, each key once", once, found["keys_once"] and found["done"] == episodes
        ),
        Outcome(
            "between two episodes of a worker, at first",
            f"< {LIMIT_GAP_MS:g} ms",
            f"{first:.2f} ms",
            first < LIMIT_GAP_MS,
        ),
        Outcome(
            "between two episodes of a worker, at last", f"< {LIMIT_GAP_MS:g} ms", f"{last:.2f} ms", last < LIMIT_GAP_MS
        ),
        Outcome(
            "the same, last over first", f"≤ {LIMIT_SLOWDOWN}", f"{last / first:.2f}", last <= LIMIT_SLOWDOWN * first
        ),
        Outcome(
            "the driver's CPU time for an episode, last over first",
            f"≤ {LIMIT_SLOWDOWN}",
            f"{slowdown:.2f} ({cpu['first']:.2f} ms at first)",
            slowdown <= LIMIT_SLOWDOWN,
        ),
        *(_growth(f"memory of the {name}", row) for name, row in found["memory"].items()),
    ]


def _growth(what: str, row: Results | None) -> Outcome:
    wanted = f"≤ {LIMIT_GROWTH_MIB:g} MiB in 1,000 episodes"
    if row is None:
        return _unmeasured(what, wanted)
    seen = f"{row['mib_per_1000']:+.3f} MiB, {row['begin_mib']:.0f} to {row['end_mib']:.0f}"
    return Outcome(what, wanted, seen, row["mib_per_1000"] <= LIMIT_GROWTH_MIB)


def _ratio(part: Results, what: str, ours: str, theirs: str, limit: float) -> Outcome:
    wanted = f"≤ {limit:.2f} x {theirs}"
    found = part.get("ratios", {}).get(ours, {}).get(theirs)
    if found is None:
        return _unmeasured(what, wanted)
    low, high = found["ci95"]
    return Outcome(what, wanted, f"{found['ratio']:.3f} ({low:.3f} to {high:.3f})", found["ratio"] <= limit)


def _default(rtt: Results) -> Outcome:
    """Faster, and no worse to look at than what vlagents sends: the same JPEG as ours at its setting."""
    found = _ratio(rtt, "WebSocket, our default setting", DEFAULT, "vlagents JPEG", 0.50)
    ours, theirs = _way(rtt, DEFAULT), _way(rtt, JPEG)
    if found.met is None or ours is None or theirs is None:
        return found
    as_good = ours["psnr_db"] is None or (theirs["psnr_db"] is not None and ours["psnr_db"] >= theirs["psnr_db"])
    seen = f"{found.measured}; PSNR {_decibels(ours)}, theirs {_decibels(theirs)}"
    return Outcome(found.what, f"{found.wanted}, PSNR no worse", seen, found.met and as_good)


def _tail(rtt: Results, name: str) -> Outcome:
    what, wanted = f"p99 over median, {name}, calls without a break", f"≤ {LIMIT_P99:g}, idle machine"
    way = next((way for way in rtt.get("steady", ()) if way["way"] == name), None)
    if way is None:
        return _unmeasured(what, wanted)
    ratio = way["p99_ms"] / way["median_ms"]
    return Outcome(what, wanted, f"{ratio:.1f}", ratio <= LIMIT_P99)


def _throughput(part: Results) -> Sequence[Outcome]:
    found = []
    for transport, limit in (("plasma", 0.95), ("handle", 0.95), ("shm", 0.95), ("websocket", 0.90)):
        row = part.get("transports", {}).get(transport)
        what = f"actions a second, 32 sessions, batches of 16, {transport}"
        wanted = f"≥ {limit:.2f} of the ideal"
        found.append(
            Outcome(what, wanted, f"{row['of_ideal']:.3f}", row["of_ideal"] >= limit)
            if row
            else _unmeasured(what, wanted)
        )
    for transport, row in part.get("transports", {}).items():
        if row["robot"] is not None:
            p99 = row["robot"]["wait_p99_ms"]
            wanted = f"p99 ≤ {LIMIT_WAIT_MS:g} ms"
            what = f"a robot's wait among 31 simulations, {transport}"
            found.append(Outcome(what, wanted, f"{p99:.1f} ms", p99 <= LIMIT_WAIT_MS))
    return found


def _way(part: Results, name: str) -> Results | None:
    return next((way for way in part.get("ways", ()) if way["way"] == name), None)


def _decibels(way: Results) -> str:
    return "lossless" if way["psnr_db"] is None else f"{way['psnr_db']:.1f} dB"


def _unmeasured(what: str, wanted: str) -> Outcome:
    return Outcome(what, wanted, "not measured", None)
