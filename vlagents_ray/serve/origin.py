"""Pages in a browser, which reach a server on their machine as any program does. Where there are keys, they need one.

A browser says in `origin` whose page it is that asks. No page is this server's own but those at its address: a name
could be another site's, which has it lead here once its page is loaded (DNS rebinding).
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from urllib.parse import urlsplit

from vlagents_ray.errors import Forbidden


def require_own_page(headers: Mapping[str, str]) -> None:
    """`Forbidden` if another site's page asks. The names in `headers` are in lower case."""
    origin = headers.get("origin")
    if origin is not None and not _is_own(origin, headers.get("host")):
        raise Forbidden(f"origin {origin[:100]}: a page of another site commands no robot; serve with keys to let it")


def _is_own(origin: str, host: str | None) -> bool:
    try:
        parts = urlsplit(origin)
        if parts.netloc != host:
            return False
        return parts.hostname == "localhost" or ipaddress.ip_address(parts.hostname or "") is not None
    except ValueError:  # no address, or no URL
        return False
