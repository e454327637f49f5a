"""Bytes <-> Obs and Act. Pure functions: no sockets, no ray. One file a protocol."""
