"""The number of examples of tests that draw many: all of them, or a fifth in `make check`, which
uses the profile `quick`.

No profile limits the time of an example: on a busy machine a time limit would fail by chance.
"""

from __future__ import annotations

from hypothesis import HealthCheck, settings

_BUSY = settings(
    settings.get_profile("default"), deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
_WHOLE = _BUSY.max_examples
settings.register_profile("default", _BUSY)
settings.register_profile("quick", _BUSY, max_examples=_WHOLE // 5)
if settings.get_current_profile_name() == "default":
    settings.load_profile("default")


def many(number: int) -> int:
    """Return `number`, or the share of it that the profile of `--hypothesis-profile` draws."""
    return number * settings().max_examples // _WHOLE
