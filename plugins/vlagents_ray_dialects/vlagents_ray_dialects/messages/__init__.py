"""Other systems' messages as values, without sockets or a server."""
