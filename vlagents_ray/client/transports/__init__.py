"""The transports of requests: shared memory, plasma, WebSocket, HTTP, and the Serve handle."""
