"""Error messages for wrong settings, with the known settings and a suggestion."""

from __future__ import annotations

import datetime
import inspect
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from vlagents_ray.errors import ConfigError, shown
from vlagents_ray.naming import did_you_mean

_BOUNDS = ("less_than", "less_than_equal", "greater_than", "greater_than_equal")
_WORD_ERRORS = (
    "int_parsing",
    "float_parsing",
    "bool_parsing",
    "list_type",
    "sequence_str",
    *_BOUNDS,
)
# How to write a value, by the type of error and the type of the value.
_SPELLINGS = {
    ("list_type", dict): "; begin each of its entries with '- '",
    ("string_type", bool): "; put the word in quotation marks",
    ("string_type", datetime.date): "; put it in quotation marks",
}
_WANT = "Input should be "  # pydantic's wording
# Types of values that a plain type allows: also numpy's, and whole numbers for a float, since YAML
# reads 1 as int.
_PLAIN: dict[type, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (numbers.Integral,),
    float: (numbers.Real,),
    str: (str,),
    type(None): (type(None),),
}


def require_arguments(what: str, function: Callable[..., Any], given: Mapping[str, Any]) -> None:
    """Raise `ConfigError` unless a function accepts these keyword arguments.

    The type of a value is compared with its parameter's annotation, or with the default if there is
    no annotation. Only numbers, strings, booleans and None are compared; values of other types are
    left to the function.

    Args:
        what: The object that the function makes, for the message.
        function: The function or class that will be called.
        given: The keyword arguments.
    """
    signature = inspect.signature(function)
    try:
        signature.bind(**given)
    except TypeError as error:
        takes = [name for name in signature.parameters if name != "self"]
        unknown = (name for name in given if name not in takes)
        meant = next(filter(None, (did_you_mean(name, takes) for name in unknown)), "")
        raise ConfigError(f"{what}: {error}; it takes {sorted(takes)}{meant}") from error
    annotated = function.__init__ if isinstance(function, type) else function  # type: ignore[misc]
    try:
        annotations = get_type_hints(annotated)
    except (NameError, TypeError, AttributeError):  # they name types that cannot be found
        annotations = {}
    for name, value in given.items():
        parameter = signature.parameters.get(name)
        # A value for **kwargs, or the default itself.
        if parameter is None or value is parameter.default:
            continue
        default = parameter.default  # without an annotation, the default 1 allows 0.5 as well
        own = Any if default is None else float if type(default) is int else type(default)
        annotation: Any = annotations.get(name, own)
        kinds = (
            list(get_args(annotation))
            if get_origin(annotation) in (Union, UnionType)
            else [annotation]
        )
        if not all(isinstance(kind, type) and kind in _PLAIN for kind in kinds):
            continue
        # A boolean does not count as a number.
        if not any(
            isinstance(value, _PLAIN[kind]) and (kind is bool or type(value) is not bool)
            for kind in kinds
        ):
            wanted = " or ".join("None" if kind is type(None) else kind.__name__ for kind in kinds)
            raise ConfigError(f"{what}: {name}: got {value!r}, want {wanted}")


def wrong_settings(error: ValueError, model: type | None = None, option: str | None = None) -> str:
    """Return the message of an error about settings.

    Args:
        error: An error; if it is pydantic's, the message has a line for each wrong setting, without
            the values, which may be secrets.
        model: The pydantic model of the settings, whose fields are listed if one is unknown.
        option: The option of the command line that sets them, such as "--set".
    """
    listed: Callable[[], Sequence[Mapping[str, Any]]] | None = getattr(error, "errors", None)
    if listed is None:
        return str(error)
    lines = [_sentence(item, model, option) for item in listed()]
    return lines[0] if len(lines) == 1 else "\n" + "\n".join(f"- {line}" for line in lines)


def _sentence(item: Mapping[str, Any], model: type | None, option: str | None) -> str:
    where = ".".join(map(str, item["loc"]))
    message = str(item["msg"]).removeprefix("Value error, ")
    name = str(item["loc"][-1]) if item["loc"] else ""
    beside = _fields(model, item["loc"][:-1])
    got = (
        item["input"]
        if isinstance(item["input"], (bool, int, float))
        else type(item["input"]).__name__
    )
    # In place of a number or a list: no secret.
    if item["type"] in _WORD_ERRORS and isinstance(item["input"], str):
        got = shown(item["input"])
        message = message.partition(", unable to")[0]
        if item["type"] in ("list_type", "sequence_str"):
            message += f", such as [{item['input'][:40]}]"
    # A word of a list is no secret.
    if item["type"] == "literal_error" and isinstance(item["input"], str):
        got = shown(item["input"])
        message += did_you_mean(item["input"], item["ctx"]["expected"].split("'")[1::2])
    if message.startswith(_WANT):
        spelling = _SPELLINGS.get((item["type"], type(item["input"])), "")
        message = f"got {got}, want {message.removeprefix(_WANT)}{spelling}"
    if item["type"] == "path_type":
        message = f"got {got}, want a path"
    if item["type"] in ("model_type", "model_attributes_type", "dict_type"):
        takes = sorted(_fields(model, item["loc"]))
        message = f"got {got}, want a mapping" + (f" with some of {takes}" if takes else "")
        message += did_you_mean(name, beside.keys() - {name})
    elif item["type"] == "missing":
        example = next(iter(getattr(beside.get(name), "examples", None) or ()), "…")
        message = (
            "is missing; give "
            f"{f'`{name}: {example}`' if option is None else f'{option} {where}={example}'}"
        )
    elif item["type"] == "extra_forbidden":
        takes = sorted(beside)
        message = "there is no such setting"
        if ":" in name:
            message += " (write a space after the colon)"
        if takes:
            message += f"; want one of {takes}{did_you_mean(name, takes)}"
    return f"{where}: {message}" if where else message


def _fields(model: type | None, place: Iterable[Any]) -> Mapping[str, Any]:
    """Return the fields at a place below `model`; empty if they cannot be determined."""
    for name in place:
        if isinstance(name, int):  # an index in a list
            continue
        field = _of(model).get(name)
        model = None if field is None else next(filter(_of, _parts(field.annotation)), None)
    return _of(model)


def _of(model: type | None) -> Mapping[str, Any]:
    """Return the fields of a model; if its fields are registered names, return those names."""
    registered: Callable[[], Mapping[str, Any]] | None = getattr(model, "registered_fields", None)
    return getattr(model, "model_fields", {}) if registered is None else registered()


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield a type and its arguments, recursively: `Batch` of `Batch | None`."""
    yield annotation
    for one in get_args(annotation):
        yield from _parts(one)
