"""Checks requests from pages in a browser, which, like any program, can reach a server on their
machine.

A server with API keys needs no such check, since a page also needs a key.

A browser sends the site of the requesting page in `origin`, and the host name of the server in
`host`. Only pages at this server's address are accepted: another site can let its own name resolve
to this machine once its page is loaded (DNS rebinding), and requests of that page to that name have
no `origin`. Therefore a request is rejected if its `host` is a name that another site could own.
Addresses, names without a dot, names of private networks, this machine's name and the names in
`access.hosts` are accepted. Programs that send no `host` are not browsers.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection, Mapping
from functools import cache, lru_cache
from urllib.parse import urlsplit

from vlagents_ray.errors import Forbidden

# Suffixes outside of the public DNS.
_PRIVATE = (".localhost", ".local", ".internal", ".lan", ".home.arpa", ".svc")
_LONGEST = 260  # maximum length of a DNS name (253 characters) and a port


def require_own_page(headers: Mapping[str, str], hosts: Collection[str] = ()) -> None:
    """Reject a request from a page of another site.

    Args:
        headers: The headers of the request; their names are in lower case.
        hosts: Further host names of this server, in lower case and without a port.

    Raises:
        Forbidden: The page belongs, or could belong, to another site.
    """
    origin = headers.get("origin")
    host = headers.get("host")
    if origin is not None and not _is_page_of(host, origin):
        raise Forbidden(
            f"origin {origin[:100]!r}: requests from a page of another site are rejected, even "
            "with a key; let the program behind that page send the request"
        )
    if host is not None and not _is_name_of_server(host, hosts):
        raise Forbidden(
            f"host {host[:100]!r}: this name may belong to another site that points it here; if "
            "it is the server's, add it to `access: {hosts: [...]}`, use the server's address, "
            "or serve with keys"
        )


def require_same_origin(headers: Mapping[str, str]) -> None:
    """Reject a GET from another site's page, even if it has no `origin`, as is the case for images.

    Raises:
        Forbidden: The browser reports that another site's page sent the request.
    """
    site = headers.get("sec-fetch-site", "none")
    if site not in ("same-origin", "none"):
        raise Forbidden(
            f"sec-fetch-site: expected 'same-origin', got {site[:40]!r}; open the live page itself"
        )


def _is_page_of(host: str | None, origin: str) -> bool:
    """Return whether the page is at the address `host` of this server, which is not a DNS name."""
    try:
        parts = urlsplit(origin)
    except ValueError:  # the origin is not a URL
        return False
    return parts.netloc == host and parts.hostname is not None and _is_address(parts.hostname)


def _is_name_of_server(host: str, hosts: Collection[str]) -> bool:
    """Return whether the name in a `host` header belongs to this server, or to no other site."""
    if len(host) > _LONGEST:
        return False
    name, is_private = _name_of(host)
    return is_private or name in hosts or name == _machine_name()


@lru_cache(maxsize=64)  # every request of a robot has the same header
def _name_of(host: str) -> tuple[str, bool]:
    """Return the name in a `host` header, without the port, and whether no other site can own
    it.
    """
    try:
        name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
    except ValueError:  # the header contains no valid host
        return "", False
    return name, "." not in name or name.endswith(_PRIVATE) or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name == "localhost"
    return True


@cache
def _machine_name() -> str:
    return socket.gethostname().lower()
