"""The endpoints of a replica: shared memory, plasma, WebSocket and HTTP."""
