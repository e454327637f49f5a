"""The files of recorded bytes: the scenarios of each file, and the code that records the file
again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from dialect_situations import DIALECTS
from endpoint_situations import CORE, Endpoint
from endpoint_situations import record as record_situations

from tests.golden import dialects, own_protocol
from tests.golden.traces import Trace, write

ALL = "all"
FILES: dict[str, Callable[[], Iterator[Trace]]] = {
    "episodes": own_protocol.episodes,
    "refusals": own_protocol.refusals,
    "streams": own_protocol.streams,
    "control_messages": own_protocol.control_messages,
    "http": own_protocol.of_http,
    "openpi": dialects.maps,
    "openvla": dialects.documents,
    "vla_eval": dialects.benchmarks,
    "gateways": dialects.gateways,
}


def record(names: Sequence[str]) -> None:
    """Record files again.

    Args:
        names: The files, such as "traces/http" or "endpoints/own_port"; `ALL` stands for all.

    Raises:
        ValueError: There is no such file.
    """
    endpoints: dict[str, Endpoint] = {
        f"endpoints/{endpoint.name}": endpoint for endpoint in [*CORE, *DIALECTS]
    }
    known = [*(f"traces/{file}" for file in FILES), *endpoints]
    unknown = sorted(set(names) - {ALL, *known})
    if unknown:
        raise ValueError(f"--record: expected {ALL!r} or some of {known}, got {unknown}")

    chosen = known if ALL in names else [name for name in known if name in names]
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen:
            if name in endpoints:
                record_situations(endpoints[name], Path(folder))
            else:
                _record_traces(name.removeprefix("traces/"), Path(folder))


def _record_traces(file: str, folder: Path) -> None:
    """Record a file of traces. Endpoints at which a scenario has the same bytes share one trace."""
    traces: list[Trace] = []
    for scenario in FILES[file]():
        played = scenario.played(scenario.endpoints[0], folder)
        for trace in traces:
            if (trace.name, trace.steps) == (played.name, played.steps):
                trace.endpoints += played.endpoints
                break
        else:
            traces.append(played)
    write(file, traces)
