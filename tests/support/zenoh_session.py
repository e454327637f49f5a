"""Zenoh sessions that connect as clients to a local port."""

from __future__ import annotations

import json
from typing import Any


def open_zenoh(port: int, mode: str = "peer") -> Any:
    """Return a session in the mode `peer` or `client`, which connects only to the peer at `port`:
    it does not scout, and does not use shared memory.
    """
    import zenoh  # the tests without extras lack zenoh

    config = zenoh.Config()
    settings = {
        "mode": mode,
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)
