"""The scenarios of each file of traces, and how they are recorded."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from dialect_situations import DIALECTS
from endpoint_situations import CORE
from endpoint_situations import record as record_situations

from tests.golden import dialects, own_protocol
from tests.golden.traces import Trace, write

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


def record() -> None:
    """Write all files again; endpoints at which a scenario's bytes are the same have one trace."""
    with tempfile.TemporaryDirectory() as folder:
        for file, scenarios in FILES.items():
            found: list[Trace] = []
            for scenario in scenarios():
                one = scenario.played(scenario.endpoints[0], Path(folder))
                same = next(
                    (
                        other
                        for other in found
                        if (other.name, other.steps) == (one.name, one.steps)
                    ),
                    None,
                )
                if same is None:
                    found.append(one)
                else:
                    same.endpoints += one.endpoints
            write(file, found)
        record_situations([*CORE, *DIALECTS], Path(folder))
