"""openpi's protocol: msgpack over WebSocket."""
