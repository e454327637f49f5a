"""Other policy servers, each in processes of its own and with a Python of its own.

A `<name>_peer.py` is a script, run by its path with the peers' Python: it imports the peer's packages, numpy, the
standard library and `peer.py` beside it, never `vlagents_ray`. `serve HOST PORT` is the peer's server with a policy
that does nothing; `drive HOST PORT OBS.npz MODE` is its own client, which obeys the line protocol of `peer.py`.
`evaluate HOST PORT PLAN`, where the peer evaluates, is a whole evaluation of its own: there alone, when an environment
is made, the script imports one thing of ours, the environment that all are measured with (`vlagents_ray.bench.noted`).
"""
