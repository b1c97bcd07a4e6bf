"""Text and values from outside: made short and safe, checked against their dataclass."""

import dataclasses
import os
import subprocess
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Ge, Gt, Len, MinLen
from hypothesis import given
from hypothesis import strategies as st

from mjx_balance.errors import InputError, quote, shell, shorten
from mjx_balance.files.validation import STRICT, check_types, parse


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("abcdefghij", "abcdefghij"),
        ("abcdefghijk", "abcd...ijk"),
        ("\x1b" + 10**6 * "b" + "the\nend", "?bbb...end"),
    ],
)
def test_the_end_of_a_long_text_can_be_kept(text: str, line: str) -> None:
    assert shorten(text, 10, tail=3) == line


def test_the_message_of_an_error_is_safe_whatever_it_quotes() -> None:
    error = InputError(f"name is {10**5 * 'x'}\u202e\x1b]0;title\x07; it must be short")
    assert len(str(error)) == 300
    assert str(error).startswith("name is xxx")
    assert str(error).endswith("x??]0;title?; it must be short")
    assert str(InputError("seed is -1")) == "seed is -1"


@pytest.mark.parametrize(
    ("text", "limit", "line"),
    [
        ("two\nlines  and\ttabs", 80, "two lines and tabs"),
        ("\x1b[2Jred\x07", 80, "?[2Jred?"),
        ("abcdefghij", 10, "abcdefghij"),
        ("abcdefghijk", 10, "abcdefg..."),
        (ValueError("what\nis wrong"), 80, "what is wrong"),
    ],
)
def test_text_becomes_one_safe_line(text: object, limit: int, line: str) -> None:
    assert shorten(text, limit) == line


@given(st.text(), st.integers(10, 100))
def test_any_text_is_short_and_printable(text: str, limit: int) -> None:
    line = shorten(text, limit)
    assert len(line) <= limit
    assert line.isprintable()


def test_values_are_quoted_as_python_writes_them() -> None:
    assert (quote("a\nb"), quote(3.5), quote((1,))) == (r"'a\nb'", "3.5", "(1,)")
    assert quote(10**5000) == "a number of thousands of digits"
    assert quote("x" * 10**6) == "'" + 76 * "x" + "..."


@dataclasses.dataclass(frozen=True)
class Wheel:
    __pydantic_config__ = STRICT

    name: str
    radius: Annotated[float, Gt(0)]
    spokes: tuple[Annotated[int, Ge(1)], ...] = (3,)


@dataclasses.dataclass(frozen=True)
class Cart:
    __pydantic_config__ = STRICT

    wheels: Annotated[tuple[Wheel, ...], Len(1, 2)]
    colour: Literal["red", "blue"] = "red"
    load: Annotated[str, MinLen(1)] | tuple[float, float] | None = None
    sprung: bool = False


def cart(**wheel: Any) -> dict[str, Any]:
    return {"wheels": [{"name": "left", "radius": 1, **wheel}]}


def test_json_values_become_a_dataclass() -> None:
    values = cart(spokes=[4, 5]) | {"load": [1, 2.5]}
    assert parse(Cart, values) == Cart((Wheel("left", 1.0, (4, 5)),), load=(1.0, 2.5))
    one = Cart((Wheel("left", 2),), "blue", sprung=True)
    assert check_types(one) is one
    assert isinstance(one.wheels[0].radius, int), "nothing is converted"


REFUSED: list[tuple[Any, str]] = [
    ([], "Cart is []; it must map its fields to values"),
    ({}, "wheels is missing"),
    ({"wheels": []}, "wheels is []; it must have a length of at least 1"),
    ({"wheels": 3 * cart()["wheels"]}, "it must have a length of at most 2"),
    ({"wheels": [3]}, "wheels is [3]; each entry must map its fields to values"),
    ({"wheels": [{"radius": -1}]}, "name of wheels[0] is missing"),
    ({"wheels": [{"name": 3, "radius": 1}]}, "name of wheels[0] is 3; it must be a text"),
    (cart(radius=0), "radius of wheel left is 0; it must be greater than 0"),
    (cart(radius=True), "radius of wheel left is True; it must be a finite number"),
    (cart(radius=float("nan")), "radius of wheel left is nan; it must be a finite number"),
    (cart(radius=None), "radius of wheel left is None; it must be a finite number"),
    (cart(spokes=[2, 0]), "spokes of wheel left is [2, 0]; each entry must be at least 1"),
    (cart(spokes="2"), "spokes of wheel left is '2'; it must be a list"),
    (cart(spoke=2), "unknown field 'spoke' of wheel left in Wheel; did you mean spokes?"),
    (cart() | {"x": 1}, "unknown field 'x' in Cart; it has wheels, colour, load, sprung"),
    (cart() | {"colour": "pink"}, "colour is 'pink'; it must be one of red, blue"),
    (cart() | {"sprung": 1}, "sprung is 1; it must be true or false"),
    (cart() | {"load": [1]}, "load is [1]; it must be a name or two places"),
    (cart() | {"load": ""}, "load is ''; it must be a name or two places"),
    (cart() | {"load": "\ud800"}, "Cart is {"),
    ({(1, 2): 3}, "{(1, 2): 3} cannot be written as JSON"),
    ({"wheels": 10**5000}, "a number of thousands of digits cannot be written as JSON"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED, ids=[x[1] for x in REFUSED])
def test_what_is_wrong_is_named_in_a_sentence(values: Any, message: str) -> None:
    with pytest.raises(InputError) as caught:
        parse(Cart, values, remedies={"load": "be a name or two places"})
    assert message in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_dataclass_is_checked_as_its_values_are() -> None:
    with pytest.raises(KeyError, match="radius of wheel left is -1; it must be greater than 0"):
        check_types(Cart((Wheel("left", -1),)), type("Own", (InputError, KeyError), {}))
    with pytest.raises(InputError, match=r"^wheels is \('round',\); each entry must be a Wheel$"):
        check_types(Cart(("round",)))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "name", ["runs/a b", "x'y", 'q"q', "$(date)", "a;b", "-n *", "back\\slash", "ü", "plain/run-1"]
)
def test_a_printed_command_can_be_pasted(name: str) -> None:
    """A shell gives the path back, as one argument and nothing else."""
    told = subprocess.run(
        ["sh", "-c", f"printf '%s|' --resume {shell(Path(name))}"], capture_output=True, check=True
    )
    assert told.stdout.decode() == f"--resume|{name}|"


def test_a_plain_path_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shell(Path("runs/best-seed0-20261128-120000")) == "runs/best-seed0-20261128-120000"
    monkeypatch.setattr(os, "name", "nt")
    assert shell(PureWindowsPath("C:/my runs/a")) == '"C:\\my runs\\a"'  # pyright: ignore
