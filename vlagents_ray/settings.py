"""Error messages for wrong settings, with the known settings and a suggestion."""

from __future__ import annotations

import datetime
import inspect
import numbers
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

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
# Hints how to write a value, by the type of error and the type of the value.
_SPELLINGS = {
    ("list_type", dict): "; begin each of its entries with '- '",
    ("string_type", bool): "; put the word in quotation marks",
    ("string_type", datetime.date): "; put it in quotation marks",
}
_EXPECTED = "Input should be "  # beginning of pydantic's messages
# The types of values that each plain type allows. numpy's numbers are allowed, and whole numbers
# are allowed for a float, since YAML reads 1 as int.
_PLAIN: dict[type, tuple[type, ...]] = {
    bool: (bool,),
    int: (numbers.Integral,),
    float: (numbers.Real,),
    str: (str,),
    type(None): (type(None),),
}


def require_arguments(
    subject: str, function: Callable[..., Any], arguments: Mapping[str, Any]
) -> None:
    """Raise `ConfigError` unless a function accepts these keyword arguments.

    The type of a value is compared with its parameter's annotation, or with the default if there is
    no annotation. Only numbers, strings, booleans and None are compared; values of other types are
    left to the function.

    Args:
        subject: The object that the function creates, for the message.
        function: The function or class that will be called.
        arguments: The keyword arguments.
    """
    signature = inspect.signature(function)
    try:
        signature.bind(**arguments)
    except TypeError as error:
        accepted = [name for name in signature.parameters if name != "self"]
        suggestion = ""
        for name in arguments:
            if name not in accepted and not suggestion:
                suggestion = did_you_mean(name, accepted)
        raise ConfigError(
            f"{subject}: {error}; it accepts {sorted(accepted) or 'none'}{suggestion}"
        ) from error

    annotated = function.__init__ if isinstance(function, type) else function  # type: ignore[misc]
    try:
        annotations = get_type_hints(annotated)
    # The annotations name types that cannot be resolved.
    except (NameError, TypeError, AttributeError):
        annotations = {}

    for name, value in arguments.items():
        parameter = signature.parameters.get(name)
        # The value may belong to **kwargs, or be the default itself.
        if parameter is None or value is parameter.default:
            continue
        annotation = annotations.get(name, _type_of_default(parameter.default))
        is_union = get_origin(annotation) in (Union, UnionType)
        kinds: list[Any] = list(get_args(annotation)) if is_union else [annotation]
        if not all(isinstance(kind, type) and kind in _PLAIN for kind in kinds):
            continue
        if not any(_is_of_kind(value, kind) for kind in kinds):
            expected = " or ".join(
                "None" if kind is type(None) else kind.__name__ for kind in kinds
            )
            raise ConfigError(f"{subject}: {name}: expected {expected}, got {value!r}")


def _type_of_default(default: object) -> Any:
    """Return the type of a parameter without an annotation, from its default; the default 1 also
    allows 0.5.
    """
    if default is None:
        return Any
    return float if type(default) is int else type(default)


def _is_of_kind(value: object, kind: type) -> bool:
    """Return whether a value is of a plain type, which includes numpy's; a boolean does not count
    as a number.
    """
    # Not imported for this: without numpy there is no such value.
    numpy = sys.modules.get("numpy")
    if kind is bool and numpy is not None and isinstance(value, numpy.bool_):
        return True
    return isinstance(value, _PLAIN[kind]) and (kind is bool or type(value) is not bool)


def wrong_settings(error: ValueError, model: type | None = None, option: str | None = None) -> str:
    """Return the message of an error about settings.

    Args:
        error: The error. For an error of pydantic, the message has a line for each wrong setting,
            without the values, which may be secrets.
        model: The pydantic model of the settings, whose fields are listed if one is unknown.
        option: The command-line option for settings, such as "--set".
    """
    listed: Callable[[], Sequence[Mapping[str, Any]]] | None = getattr(error, "errors", None)
    if listed is None:
        return str(error)
    lines = [_sentence(item, model, option) for item in listed()]
    if len(lines) == 1:
        return lines[0]
    return "\n" + "\n".join(f"- {line}" for line in lines)


def _sentence(item: Mapping[str, Any], model: type | None, option: str | None) -> str:
    """Return the message for an item of pydantic's list of errors."""
    kind = item["type"]
    where = ".".join(map(str, item["loc"]))
    name = str(item["loc"][-1]) if item["loc"] else ""
    siblings = _fields(model, item["loc"][:-1])

    message, value_text, hint = _reworded(item)
    if message.startswith(_EXPECTED):
        message = f"expected {message.removeprefix(_EXPECTED)}, got {value_text}{hint}"
    if kind == "path_type":
        message = f"expected a path, got {value_text}"

    if kind in ("model_type", "model_attributes_type", "dict_type"):
        accepted = sorted(_fields(model, item["loc"]))
        message = "expected a mapping"
        if accepted:
            message += f" with some of {accepted}"
        message += f", got {value_text}"
        message += did_you_mean(name, siblings.keys() - {name})
    elif kind == "missing":
        example = next(iter(getattr(siblings.get(name), "examples", None) or ()), "…")
        setting = f"`{name}: {example}`" if option is None else f"{option} {where}={example}"
        message = f"is missing; add {setting}"
    elif kind == "extra_forbidden":
        accepted = sorted(siblings)
        message = "there is no such setting"
        if ":" in name:
            message += " (write a space after the colon)"
        if accepted:
            message += f"; expected one of {accepted}{did_you_mean(name, accepted)}"
    return f"{where}: {message}" if where else message


def _reworded(item: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return pydantic's message in clearer words, the text of the value, and a hint."""
    kind, value = item["type"], item["input"]
    message = str(item["msg"]).removeprefix("Value error, ")
    # Only the type of any other value is shown, as the value may be a secret.
    value_text = str(value) if isinstance(value, (bool, int, float)) else type(value).__name__
    if value is None:
        value_text = "nothing"
    # Text that is written in place of a number or a list is not a secret, so it is shown.
    if kind in _WORD_ERRORS and isinstance(value, str):
        value_text = shown(value)
        message = message.partition(", unable to")[0]
        if kind in ("list_type", "sequence_str"):
            message += f", such as [{value[:40]}]"

    hint = _SPELLINGS.get((kind, type(value)), "")
    if kind == "literal_error" and isinstance(value, str):
        # Text that is written in place of one of the allowed words is not a secret either.
        value_text = shown(value)
        hint = did_you_mean(value, item["ctx"]["expected"].split("'")[1::2])
    elif kind == "bool_parsing":
        hint = "; write true or false"
    elif kind == "int_from_float":
        message = message.partition(", got a number")[0]
    elif kind == "too_short" and not value:
        number = item["ctx"]["min_length"]
        message = f"{_EXPECTED}at least {number} {'entry' if number == 1 else 'entries'}"
        value_text = "none"
    elif kind == "invalid_key":
        message = f"{_EXPECTED}a name as a key"
        value_text = str(item["loc"][-1])
        hint = "; correct it, or put it in quotation marks"
    return message, value_text, hint


def _fields(model: type | None, path: Iterable[Any]) -> Mapping[str, Any]:
    """Return the fields of the model at a path below `model`; empty if they are unknown."""
    is_key = False  # whether the next name is a key of a dict, not a field
    for name in path:
        if isinstance(name, int):  # an index of a list
            continue
        if is_key:
            is_key = False
            continue
        field = _of(model).get(name)
        is_key = get_origin(getattr(field, "annotation", None)) is dict
        model = None if field is None else next(filter(_of, _parts(field.annotation)), None)
    return _of(model)


def _of(model: type | None) -> Mapping[str, Any]:
    """Return the fields of a model; if its fields are registered names, return those names."""
    registered: Callable[[], Mapping[str, Any]] | None = getattr(model, "registered_fields", None)
    return getattr(model, "model_fields", {}) if registered is None else registered()


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield a type and its arguments, recursively; for `Batch | None` these include `Batch`."""
    yield annotation
    for argument in get_args(annotation):
        yield from _parts(argument)
