"""Files that no reader of YAML accepts, for tests here and of plug-ins."""

from __future__ import annotations

# By mistake: the file's bytes, and a word that its error contains.
WRONG = {
    "a key twice": (b'{"keys": [], "keys": []}', "twice"),
    "not closed": (b"{a: [1, 2", ""),
    "a tab": (b"a:\n\t- 1\n\tb: 2", ""),
    "not UTF-8": (b"\xff\xfe\x00a", ""),
    "an object of Python": (b"{a: !!python/object/apply:os.getcwd []}", ""),
    "nested deeply": (b"[" * 5000, ""),
}
