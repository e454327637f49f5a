"""API keys without a file, which a test can change while they are in use."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from vlagents_ray.serve.access.api_keys import Keys


class ChangingKeys:
    """Keys that a test can change. `keys` sees a change when it reads the keys again, which is at
    each request if `api_keys._CHECK_S` is 0.
    """

    def __init__(self) -> None:
        self._entries: dict[str, dict[str, Any]] = {}
        self._version = 0
        self.keys = self.another()

    def another(self) -> Keys:
        """Return the same keys as another process would read them."""
        return Keys(
            lambda: json.dumps({"keys": list(self._entries.values())}), lambda: self._version
        )

    def add(self, name: str, **allowed: Any) -> str:
        """Add a key of that name, and return the secret that clients send."""
        token = f"vlr_{name}"
        self.change(name, name=name, sha256=hashlib.sha256(token.encode()).hexdigest(), **allowed)
        return token

    def change(self, key: str, **fields: Any) -> None:
        """Change the limits of the key of that name."""
        self._entries[key] = self._entries.get(key, {}) | fields
        self._version += 1
