"""Results of evaluations for others: bundles and their checks, merged folders, exports, and
trackers.
"""
