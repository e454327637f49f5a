"""A count of the programs that JAX compiles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_EVENT = "/jax/core/compile/backend_compile_duration"


@contextmanager
def jax_compiles() -> Iterator[list[str]]:
    """Return a list that grows by an entry for each program that JAX compiles within the
    context.
    """
    import jax

    found: list[str] = []

    def note(event: str, _: float, **details: Any) -> None:
        if event == _EVENT:
            found.append(str(details.get("fun_name", event)))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        yield found
    finally:
        # JAX has no public function for this.
        from jax._src.monitoring import _unregister_event_duration_listener_by_callback

        _unregister_event_duration_listener_by_callback(note)
