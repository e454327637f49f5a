"""Other systems' protocols on the server's own port, so that their clients run against it as they are.

One file a dialect: it turns what its client sends into an `Obs` by a key mapping, puts that into the same batch queue
as everybody's, and answers as its client expects. What its bytes mean is in `vlagents_ray.wire`.
"""
