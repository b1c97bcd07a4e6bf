"""Terminals that know ASCII alone, files as other systems' editors write them."""

import codecs
import io
import sys
from pathlib import Path

import pytest
from rich.console import Console

from mjx_balance.cli import main
from mjx_balance.policy.file import load_policy
from mjx_balance.report.progress import Display
from mjx_balance.robots.schema import read_robot_file
from mjx_balance.sim.scene import scene_dir


def ascii_stream() -> io.TextIOWrapper:
    """A strict stream, as Python opens a terminal of the locale C."""
    return io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict", write_through=True)


def written(stream: io.TextIOWrapper) -> str:
    buffer = stream.buffer
    assert isinstance(buffer, io.BytesIO)
    return buffer.getvalue().decode("ascii")


@pytest.fixture
def umlauts(tmp_path: Path) -> Path:
    """Our robot with names that are not ASCII."""
    model = (scene_dir() / "quadruped.xml").read_text(encoding="utf-8")
    path = tmp_path / "hüfte.xml"
    path.write_text(model.replace("LF_abduction", "LF_Hüfte"), encoding="utf-8")
    return path


def test_progress_is_shown_on_an_ascii_terminal() -> None:
    """A spinner, a bar and the panel of a training, each drawn at least once."""
    stream = ascii_stream()
    display = Display(Console(file=stream, force_terminal=True, width=100))
    with display.phase("compiling"):
        pass
    with display.bar("evaluating") as bar:
        bar(0.5)
    with display.training(0, 100):
        display.update(50, {"train/tilt_deg": 0.25})
    assert "0.250 deg" in written(stream)


def test_names_that_a_terminal_cannot_show_are_escaped(
    umlauts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = ascii_stream()
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["robot", "new", str(umlauts)]) == 0
    assert r"LF_H\xfcfte" in written(stream)


@pytest.mark.parametrize("name", ["\udcff", "h\u00fcfte", "\U0001f415"])
def test_any_file_name_can_be_printed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes that are no UTF-8 included, which Python keeps as lone surrogates."""
    stream, out = ascii_stream(), tmp_path / f"{name}.safetensors"
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["export", "best", "--out", str(out)]) == 0
    assert "kB, format" in written(stream)
    assert load_policy(out).fingerprint == load_policy("best").fingerprint


def test_a_byte_order_mark_is_no_part_of_a_file(
    umlauts: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Notepad and PowerShell write one; a robot and the values of a sweep mean the same."""
    plain, marked = tmp_path / "plain.toml", tmp_path / "marked.toml"
    assert main(["robot", "new", str(umlauts), "--out", str(plain)]) == 0
    marked.write_bytes(codecs.BOM_UTF8 + plain.read_bytes())
    assert read_robot_file(marked).legs == read_robot_file(plain).legs
    values = tmp_path / "values"
    values.write_bytes(codecs.BOM_UTF8 + b"gamma=0.1,7\n")
    assert main(["sweep", f"@{values}", "--preset", "smoke"]) == 2
    assert "gamma is 7" in capsys.readouterr().err


def test_utf_16_is_refused_with_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What `>` of Windows PowerShell writes."""
    for command, name in ((["robot", "check"], "dog.toml"), (["sweep"], "values")):
        path = tmp_path / name
        path.write_bytes("gamma=0.1".encode("utf-16"))
        where = f"@{path}" if command == ["sweep"] else str(path)
        assert main([*command, where]) == 2
        said = capsys.readouterr().err
        assert "cannot be read" in said
        assert said.count("\n") == 1
