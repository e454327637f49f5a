"""How requests reach a server: shared memory, plasma, WebSocket, HTTP, or a Serve handle."""
