"""Observers of the requests and answers of a replica: the live page, the last seconds, and recordings."""
