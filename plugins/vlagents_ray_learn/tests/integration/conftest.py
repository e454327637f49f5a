"""Real servers on real Ray, as in tests/integration, whose fixture and marker these tests have."""

from __future__ import annotations

from tests.integration.conftest import importable_agents, pytest_itemcollected

__all__ = ["importable_agents", "pytest_itemcollected"]
