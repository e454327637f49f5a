"""Fixtures for tests of dialects."""

from dialect_fixtures import everything, one_replica, open_dialect

__all__ = ["everything", "one_replica", "open_dialect"]
