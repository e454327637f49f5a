"""API keys without a file, which a test changes while they are in use."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from vlagents_ray.serve.access.api_keys import Keys


class ChangingKeys:
    """`keys` sees a change when it reads them again, at every request if `api_keys._CHECK_S` is
    0.
    """

    def __init__(self) -> None:
        self._entries: dict[str, dict[str, Any]] = {}
        self._version = 0
        self.keys = self.another()

    def another(self) -> Keys:
        """The same keys, as another process has them."""
        return Keys(
            lambda: json.dumps({"keys": list(self._entries.values())}), lambda: self._version
        )

    def add(self, name: str, **allowed: Any) -> str:
        """A key of that name; returns what its holder shows."""
        token = f"vlr_{name}"
        self.change(name, name=name, sha256=hashlib.sha256(token.encode()).hexdigest(), **allowed)
        return token

    def change(self, key: str, **fields: Any) -> None:
        """Give the key of that name other limits."""
        self._entries[key] = self._entries.get(key, {}) | fields
        self._version += 1
