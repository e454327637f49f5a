"""The live page: what the sessions of a server do now, in a browser."""
