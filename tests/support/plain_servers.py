"""HTTP servers that are not policy servers, for clients with a wrong URL."""

from __future__ import annotations

import contextlib
import http.server
import ssl
import threading
from collections.abc import Iterator


class WithoutPaths(http.server.BaseHTTPRequestHandler):
    """A server without an application at any path."""

    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self.send_error(404)

    def log_message(self, *_: object) -> None: ...


@contextlib.contextmanager
def http_server(
    context: ssl.SSLContext | None = None,
    host: str = "127.0.0.1",
    handler: type[http.server.BaseHTTPRequestHandler] = http.server.BaseHTTPRequestHandler,
) -> Iterator[int]:
    with http.server.ThreadingHTTPServer((host, 0), handler) as server:
        server.handle_error = lambda *_: None  # type: ignore[method-assign]
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()
