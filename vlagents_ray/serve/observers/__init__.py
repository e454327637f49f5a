"""Observers of the requests and answers of a replica: the live page, recordings and traces."""
