"""What all tests with openpi's source need."""

from __future__ import annotations

import pytest

MARKS = [
    pytest.mark.source("OPENPI_SRC"),
    # ml_collections 1.0.0 has a pattern that is no raw string.
    pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning"),
]
