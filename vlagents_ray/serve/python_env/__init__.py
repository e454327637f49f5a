"""Policies in separate Python environments, with other versions of packages or of Python than
the server's.
"""
