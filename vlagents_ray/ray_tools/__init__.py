"""Ray around this project: joining or starting a cluster, watching its head, cleaning up after
it.
"""
