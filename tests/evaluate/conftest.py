"""Fixtures for tests of evaluations."""

from evaluation_fixtures import commits_reach_the_disk, config

__all__ = ["commits_reach_the_disk", "config"]
