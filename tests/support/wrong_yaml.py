"""Files that are invalid YAML, for tests of this package and of plug-ins."""

from __future__ import annotations

# For each mistake, the file's bytes and a word in the error message.
WRONG = {
    "a key twice": (b'{"keys": [], "keys": []}', "twice"),
    "not closed": (b"{a: [1, 2", ""),
    "a tab": (b"a:\n\t- 1\n\tb: 2", ""),
    "not UTF-8": (b"\xff\xfe\x00a", ""),
    "an object of Python": (b"{a: !!python/object/apply:os.getcwd []}", ""),
    "nested deeply": (b"[" * 5000, ""),
}
