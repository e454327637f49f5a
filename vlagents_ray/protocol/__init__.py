"""The wire protocol of this project: it turns bytes into Obs and Act and back, without threads, sockets or Ray."""
