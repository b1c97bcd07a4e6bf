"""What imports print and bring along."""

import importlib
import sys
import types

import pytest

from mjx_balance.quiet import quiet_imports
from mjx_balance.sim.engines.table import unused_modules


def test_pytorch_is_not_there_while_others_are_imported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    with quiet_imports("torch"):
        print("Failed to import warp")
        with pytest.raises(ImportError):
            importlib.import_module("torch")
    assert "torch" not in sys.modules
    assert capsys.readouterr().out == ""


def test_only_the_engine_that_runs_brings_its_library() -> None:
    assert [unused_modules(name) for name in ("mjx", "mujoco", "warp")] == [["warp"], ["warp"], []]


def test_pytorch_that_is_in_use_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    used = types.ModuleType("torch")
    monkeypatch.setitem(sys.modules, "torch", used)
    with quiet_imports("torch"):
        assert importlib.import_module("torch") is used
    assert sys.modules["torch"] is used
