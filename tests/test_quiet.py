"""What imports print and bring along."""

import importlib
import os
import subprocess
import sys
import types
from pathlib import Path

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


DRAWS_NOTHING = """
import mjx_balance, os, sys, mujoco, mujoco.batch
own = [x.rpartition(".")[2] for x in sys.modules if x.rpartition(".")[0] == "mujoco"]
assert "_enums" in own and all(hasattr(mujoco, x) for x in own)  # MJX asks for them so
model = mujoco.MjModel.from_xml_string("<mujoco/>")
print(mujoco.batch.Batch(model, 2, 1).qpos.shape, os.environ["MUJOCO_GL"])
"""


@pytest.mark.parametrize("chosen", ["wgl", "osmesa", "egl", "\u00fc"])
def test_mujoco_is_imported_whatever_draws(chosen: str, tmp_path: Path) -> None:
    """A backend of Windows, one of nobody, and two whose libraries PyOpenGL does not find."""
    (tmp_path / "OpenGL").mkdir()
    broken = "raise AttributeError(\"'NoneType' object has no attribute 'glGetError'\")"
    (tmp_path / "OpenGL" / "__init__.py").write_text(broken, "utf-8")
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", DRAWS_NOTHING],
        env=os.environ | {"MUJOCO_GL": chosen, "PYTHONPATH": path, "PYTHONIOENCODING": "utf-8"},
        capture_output=True,
        encoding="utf-8",
    )
    assert (done.stdout, done.stderr) == (f"(2, 0) {chosen}\n", "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variable", "sentence"),
    [
        ("JAX_PLATFORMS=cuda", "JAX_PLATFORMS is 'cuda', and JAX finds no such device; set"),
        ("JAX_PLATFORMS=gpu", "JAX_PLATFORMS is 'gpu', and JAX finds no such device (Unable"),
        ("JAX_PLATFORMS=abacus", "JAX_PLATFORMS is 'abacus', and JAX finds no such device (Unable"),
        ("JAX_ENABLE_X64=often", "JAX cannot be imported: invalid truth value 'often'"),
        ("JAX_NUM_CPU_DEVICES=all", 'JAX cannot be imported: Invalid value "all" for JAX flag'),
    ],
)
def test_variables_of_others_end_a_training_with_a_sentence(
    variable: str, sentence: str, tmp_path: Path
) -> None:
    """On a machine without a GPU; nothing is written."""
    done = subprocess.run(
        [sys.executable, "-m", "mjx_balance", "train", "--preset", "smoke"],
        cwd=tmp_path,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(sys.path)}
        | {"MJX_BALANCE_CACHE": "cache"}
        | dict([variable.split("=")]),
        capture_output=True,
        text=True,
    )
    if "cuda" in variable and done.returncode == 0:
        pytest.skip("there is a GPU")
    assert done.stderr.startswith(f"mjx-balance: {sentence}")
    assert (done.stderr.count("\n"), done.returncode) == (1, 2)
    assert not (tmp_path / "runs").exists()
