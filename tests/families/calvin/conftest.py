"""CALVIN's checkout, which its simulator and its chains of tasks come from."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def checkout() -> Path:
    return Path(os.environ["CALVIN_SRC"]).resolve()
