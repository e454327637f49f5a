"""GR00T's protocol: msgpack over ZeroMQ, on its own port."""
