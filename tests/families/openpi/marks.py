"""What all tests with openpi's source need."""

from __future__ import annotations

import pytest

MARKS = [
    pytest.mark.source("OPENPI_SRC"),
    # ml_collections 1.0.0 has a pattern that is no raw string.
    pytest.mark.filterwarnings("ignore:invalid escape sequence:DeprecationWarning"),
    # flax 0.10.2 calls JAX in ways that 0.5.3 deprecates.
    pytest.mark.filterwarnings("ignore:linear_util.wrap_init is missing a DebugInfo object:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:shape requires ndarray or scalar arguments:DeprecationWarning:flax.core.scope"),
]
