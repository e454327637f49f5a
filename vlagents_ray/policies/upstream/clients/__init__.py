"""The clients of other policy servers, one module a protocol."""
