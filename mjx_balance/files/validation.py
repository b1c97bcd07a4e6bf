"""Validates untrusted values with pydantic against dataclasses.

Dataclasses with `__pydantic_config__ = STRICT` convert only an int to a float and a JSON list to a
tuple.
"""

import dataclasses
import difflib
import functools
import json
import re
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from mjx_balance.errors import MESSAGE, InputError, quote, shorten

T = TypeVar("T")

STRICT: Any = {
    "strict": True,
    "extra": "forbid",
    "allow_inf_nan": False,
    "revalidate_instances": "always",
}

REMEDIES = {
    "float_type": "be a finite number",
    "finite_number": "be a finite number",
    "int_type": "be a whole number",
    "bool_type": "be true or false",
    "string_type": "be a text",
    "string_too_short": "be a name",
    "tuple_type": "be a list",
    "list_type": "be a list",
    "dict_type": "map names to values",
    "dataclass_type": "map its fields to values",
    "dataclass_exact_type": "be a {class_name}",
    "greater_than": "be greater than {gt:.15g}",
    "greater_than_equal": "be at least {ge:.15g}",
    "less_than": "be less than {lt:.15g}",
    "less_than_equal": "be at most {le:.15g}",
    "literal_error": "be one of {expected}",
    "too_short": "have a length of at least {min_length}",
    "too_long": "have a length of at most {max_length}",
    "missing": "have more entries",
}
"""Type of pydantic's error -> how to complete "it must ..."; placeholders are pydantic's."""


@functools.cache
def _adapter(kind: Any) -> Any:
    import pydantic  # here, because it is slow to import and `import mjx_balance` can do without

    return pydantic.TypeAdapter(kind)


def check_types(value: T, error: type[InputError] = InputError) -> T:
    """Returns a dataclass if its fields have the types and bounds that its class declares.

    Raises:
      InputError: of class `error`; names the first invalid field, its value and a remedy.
    """
    try:
        _adapter(type(value)).validate_python(value)
    except ValueError as broken:
        raise error(_sentence(broken, type(value), value)) from broken
    return value


def parse(
    kind: type[T],
    values: Any,
    error: type[InputError] = InputError,
    remedies: Mapping[str, str] | None = None,
    name: str = "",
) -> T:
    """Builds a dataclass, or a value of another type, from JSON values.

    Args:
      kind: the type.
      values: from `json.loads` or `tomllib.loads`.
      error: class to raise.
      remedies: {field: end of "it must ..."}, where it differs from `REMEDIES`.
      name: of the value in messages; "": the type's.

    Raises:
      InputError: as `check_types`.
    """
    try:
        return _adapter(kind).validate_json(json.dumps(values, default=str), strict=True)
    except (TypeError, RecursionError, ValueError) as broken:
        if not hasattr(broken, "errors"):  # json's own, as for an int of too many digits
            raise error(f"{quote(values)} cannot be written as JSON") from broken
        raise error(_sentence(broken, kind, values, remedies, name)) from broken


def _sentence(
    error: Any, kind: Any, value: Any, remedies: Mapping[str, str] | None = None, name: str = ""
) -> str:
    """The message of pydantic's first error: field, value and what would be right."""
    first = error.errors(include_url=False)[0]
    code, path, given = first["type"], first["loc"], first["input"]
    name, owner, subject = name or error.title, "", "it"
    for k, place in enumerate(path):
        child = _child(value, place)
        title = _child(child, "name")
        if code == "missing" and k == len(path) - 1 and isinstance(place, str):
            return f"{place}{owner} is missing"
        if child is None and given is not None:
            break  # pydantic names a type of a union here, or an entry that is missing
        if isinstance(place, str):
            name, value = place, child
        elif isinstance(title, str):
            owner, value = f" of {name.removesuffix('s')} {shorten(title)}", child
        elif isinstance(child, dict | list) and any(isinstance(x, str) for x in path[k:]):
            owner, value = f" of {name}[{place}]", child
        else:
            subject = "each entry"
            break
    else:
        if code == "unexpected_keyword_argument":
            return _unknown_field(name, owner, kind, path)
    context = first.get("ctx", {})
    if code == "literal_error":
        context = {"expected": ", ".join(re.findall("'([^']*)'", context["expected"]))}
    complaint = f"{name}{owner} is {quote(value)}"
    if remedies and name in remedies:
        return f"{complaint}; it must {remedies[name]}"
    if code not in REMEDIES:
        return f"{complaint}: {shorten(first['msg'], MESSAGE)}"
    return f"{complaint}; {subject} must {REMEDIES[code].format_map(context)}"


def _child(value: Any, place: str | int) -> Any:
    """A field or an entry of a value, or None."""
    if isinstance(value, Mapping):
        return value.get(place)
    if isinstance(value, (list, tuple)):
        return value[place] if isinstance(place, int) and place < len(value) else None
    return getattr(value, str(place), None) if dataclasses.is_dataclass(value) else None


def _unknown_field(name: str, owner: str, kind: Any, path: tuple[str | int, ...]) -> str:
    for place in path[:-1]:
        if isinstance(place, str):
            kind = typing.get_type_hints(kind)[place]
        while not dataclasses.is_dataclass(kind):
            kind = next(x for x in typing.get_args(kind) if x not in (None, Ellipsis))
    known = [field.name for field in dataclasses.fields(kind)]
    close = difflib.get_close_matches(name, known, n=1)
    remedy = f"did you mean {close[0]}?" if close else f"it has {shorten(', '.join(known), 200)}"
    return f"unknown field {quote(name)}{owner} in {kind.__name__}; {remedy}"
