"""Results of evaluations for other programs and people: bundles and their checks, merged folders,
exports, and trackers.
"""
