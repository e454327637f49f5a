"""The YAML reader of the whole package: a key that is written twice is an error, and `1e-4` is a
number.
"""

from __future__ import annotations

import functools
import itertools
import re
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import CORE, require

_MOST_BY_ALIASES = 10_000  # values that aliases may add; a run file has a few hundred in all
# YAML 1.1 reads only `1.0e+12` as a number, and `1e12` as text; YAML 1.2 and JSON read both as
# numbers.
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+")


def load_yaml(text: str, *, extra: str = "serve", distribution: str = CORE) -> Any:
    """Return the document in a text.

    Args:
        text: YAML.
        extra: The extra to install if PyYAML is missing.
        distribution: The distribution of that extra.

    Raises:
        ValueError: The text is not YAML, or has a key twice in one mapping.
        MissingDependency: PyYAML is not installed.
    """
    yaml = require("yaml", extra=extra, distribution=distribution)
    try:
        return yaml.load(text, Loader=_loader(yaml))
    except yaml.YAMLError as error:
        reason = str(error).replace('in "<unicode string>", ', "in ")
        if "character '\\t'" in reason:
            reason += "; write spaces, as YAML allows no tab there"
        raise ValueError(reason) from error
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_yaml(file: Path | str, *, extra: str = "serve") -> Any:
    """Return the document in a file; raise `ConfigError` if it cannot be read or `load_yaml`
    raises.
    """
    try:
        return load_yaml(Path(file).read_text(encoding="utf-8"), extra=extra)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read ({error.strerror})") from error
    except ValueError as error:  # includes the error for a file that is not UTF-8
        raise ConfigError(f"{file}: not YAML ({error})") from error


def _require_small(yaml: Any, document: Any) -> None:
    """Raise `yaml.constructor.ConstructorError` if the aliases of a document, followed, make it
    much larger than its text, or endless: whoever validates or prints it follows them.
    """
    sizes: dict[int, int] = {}  # by id of a node, with all nodes below; 0 while they are counted

    def count(node: Any) -> int:
        """Return the number of nodes of which a node consists."""
        size = sizes.get(id(node))
        if size == 0:
            raise yaml.constructor.ConstructorError(
                None, None, "an alias (*) names a value that contains it", node.start_mark
            )
        if size is None:
            sizes[id(node)] = 0
            below = node.value if isinstance(node, yaml.CollectionNode) else ()
            if isinstance(node, yaml.MappingNode):
                below = itertools.chain.from_iterable(node.value)
            size = sizes[id(node)] = 1 + sum(count(child) for child in below)
        return size

    if count(document) > len(sizes) + _MOST_BY_ALIASES:
        raise yaml.constructor.ConstructorError(
            None,
            None,
            f"its aliases (*) stand for more than {_MOST_BY_ALIASES} values",
            document.start_mark,
        )


@functools.cache
def _loader(yaml: Any) -> Any:
    """Return a PyYAML loader class that rejects a key that is written twice, and reads `1e-4` as a
    number.
    """

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        def get_single_node(self) -> Any:
            """Return the document, whose aliases must not make it large."""
            node = super().get_single_node()
            if node is not None:
                _require_small(yaml, node)
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            """Return a mapping, whose keys must differ."""
            first: dict[tuple[str, str], Any] = {}
            for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
                if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
                    continue
                earlier = first.setdefault((key.tag, key.value), key)
                if earlier is not key:
                    raise yaml.constructor.ConstructorError(
                        f"the key {key.value!r} is written twice, first at",
                        earlier.start_mark,
                        "and again here; keep one of the two",
                        key.start_mark,
                    )
            return super().construct_mapping(node, deep)

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))
    return Loader
