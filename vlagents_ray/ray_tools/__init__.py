"""Functions around Ray: joining or starting a cluster, monitoring its head, and cleaning up after
it.
"""
