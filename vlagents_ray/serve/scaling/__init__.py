"""Several replicas: autoscaling, the choice of a replica for each session, and moves of sessions
between them.
"""
