"""The wheel has everything: it works in an empty folder, without the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from mjx_balance.robots.catalogue import makers, shipped

pytestmark = pytest.mark.slow

REPO = Path(__file__).resolve().parent.parent
MOST_BYTES = 3_000_000
PAGE_BYTES = 3_200_000  #: of the page of `view --browser`, which `make dist` builds where npm is
PAGE = "mjx_balance/page/index.html"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(folder)]
    subprocess.run([*command, str(REPO)], check=True)
    (file,) = folder.iterdir()
    return file


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that the wheel alone is in."""
    folder = tmp_path_factory.mktemp("installed")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_what_is_in_it(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {"py.typed", "runtime.py", "policies/best.safetensors", "report/page.html"}
    expected |= {"policy/runtime.h.in"}
    expected |= {"policies/real.safetensors"}
    expected |= {f"scenes/{name}.xml" for name in ("board", "quadruped", "scene")}
    expected |= {f"robots/{name}.toml" for name in shipped()}
    expected |= {f"policies/robots/{name}.safetensors" for name in makers()}
    expected = {f"mjx_balance/{name}" for name in expected}
    assert expected <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "docs/"))]
    policies = {name for name in names if name.startswith("mjx_balance/policies/")}
    assert policies == {name for name in expected if name.endswith(".safetensors")}
    built = (REPO / PAGE).is_file()
    assert (PAGE in names) == built
    assert wheel.stat().st_size <= MOST_BYTES + built * PAGE_BYTES


def run(installed: Path, folder: Path, *arguments: str) -> str:
    """What `mjx-balance` says in an empty folder, of the installed wheel and without JAX."""
    code = (
        "import sys; sys.modules['jax'] = None; import mjx_balance, mjx_balance.cli; "
        f"assert mjx_balance.__file__.startswith({str(installed)!r}), mjx_balance.__file__; "
        "sys.exit(mjx_balance.cli.main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
    )
    return f"{done.returncode} {done.stdout} {done.stderr}"


def test_it_evaluates_exports_and_checks_robots_anywhere(installed: Path, tmp_path: Path) -> None:
    flags = ("--scenarios", "2", "--duration", "2", "--json", "out.json")
    assert run(installed, tmp_path, "evaluate", "best", *flags).startswith("0 ")
    assert run(installed, tmp_path, "export", "best", "--out", "p.onnx").startswith("0 ")
    assert "15.20 kg" in run(installed, tmp_path, "robot", "check", "quadruped")
    assert {p.name for p in tmp_path.iterdir()} == {"out.json", "p.onnx", "quadruped-check.png"}


def test_training_without_what_it_needs_says_so(installed: Path, tmp_path: Path) -> None:
    output = run(installed, tmp_path, "train", "--preset", "smoke")
    assert output.startswith("2 ")
    assert "training needs jax, which is not installed; the extra train brings it" in output
    assert "`pip install 'WHEEL[train]'`" in output
    assert list(tmp_path.iterdir()) == []
