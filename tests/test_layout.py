"""The house: a module imports only from lower floors, read from its syntax tree."""

import ast
import re
from pathlib import Path

import pytest

import mjx_balance

PACKAGE = Path(mjx_balance.__file__).resolve().parent
PAGE = PACKAGE.parent / "ARCHITECTURE.md"

FLOORS = (
    tuple("errors quiet sources gym_registration runtime".split()),
    ("robots.record",),
    ("robots.file",),
    ("robots.measuring",),
    ("robots.building",),
    ("robots.draft",),
    ("robots",),
    ("config",),
    ("task", "statistics", "run_folder"),
    (
        *"task.actions task.attitude task.kinematics task.observation task.randomization".split(),
        *"task.pushes task.reward task.symmetry task.tilt dqn dqn.heads dqn.devices".split(),
    ),
    (
        "task.decision",
        *"dqn.acting dqn.means dqn.networks dqn.replay dqn.whitening".split(),
    ),
    ("scene", "suites", "policy", "dqn.collecting", "dqn.updating"),
    ("model_fields", "dqn.learner", "onnx_export"),
    ("engines", "engines.ffi", "engines.mujoco", "engines.engine", "controllers"),
    ("engines.mjx", "engines.compiled", "inspection", "boards"),
    ("engines.warp", "evaluation"),
    ("engines.choice", "viewing"),
    ("env",),
    ("render", "display", "report"),
    ("gym_envs", "brax_training"),
    ("report.figures", "report.tables", "report.digest"),
    ("report.reading",),
    ("report.measuring",),
    ("report.page",),
    ("training.processes",),
    ("training.checkpoints", "training.program_cache"),
    ("training.devices", "training.loop", "training.profiling"),
    ("training.validation",),
    ("training.finish",),
    ("training.run",),
    ("training",),
    ("cli",),
    ("__main__",),
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
WITHOUT_JAX = set(
    "robots config errors quiet sources task scene model_fields suites policy run_folder "
    "controllers evaluation inspection statistics render report display onnx_export boards "
    "gym_registration gym_envs runtime viewing".split()
)
"""With everything in them."""
WITHOUT_JAX_TOO = {"dqn", "dqn.heads", "engines", "engines.mujoco"}
JAX = {"jax", "jaxlib", "flax", "brax", "optax", "orbax"}


def module_name(path: Path) -> str:
    """`task/tilt.py` -> `task.tilt`, `task/__init__.py` -> `task`, `__init__.py` -> ``."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}
INSIDE = sorted(name for name in MODULES if name)


def imported(name: str) -> set[str]:
    """Full dotted names that a module imports anywhere, functions included."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{name} has a relative import; write it in full"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def imported_modules(name: str) -> set[str]:
    """Modules of the package that a module imports; `` is the package's own __init__."""
    found = set()
    for target in imported(name):
        root, *parts = target.split(".")
        if root == PACKAGE.name:
            while parts and ".".join(parts) not in MODULES:
                parts.pop()
            found.add(".".join(parts))
    return found


def needs_no_jax(name: str) -> bool:
    return name in WITHOUT_JAX_TOO or name.split(".")[0] in WITHOUT_JAX


def test_every_module_has_a_floor() -> None:
    unknown = [name for name in INSIDE if name not in FLOOR]
    assert not unknown, f"{unknown} have no floor yet: give them one in tests/test_layout.py"


@pytest.mark.parametrize("name", INSIDE)
def test_module_imports_only_from_lower_floors(name: str) -> None:
    for target in imported_modules(name):
        assert target, f"{name} imports from the package itself; name the module"
        floor, below = FLOOR.get(name), FLOOR.get(target)
        assert floor is not None, f"{name} has no floor yet"
        assert below is not None, f"{name} imports {target}, which has no floor yet"
        assert below < floor, f"{name} (floor {floor}) imports {target} (floor {below})"


def told_floors() -> dict[str, int]:
    """Floors of ARCHITECTURE.md by module, or by folder with a dot at its end."""
    floors = {}
    for floor, places in re.findall(r"^\| (\d) \| (.+?) \|", PAGE.read_text(), re.MULTILINE):
        for place in re.findall(r"`([\w/]+?)(?:\.py|(?<=/))`", places):
            floors[place.replace("/", ".")] = int(floor)
    return floors


def told_floor(name: str) -> int:
    """Where ARCHITECTURE.md puts a module: by its own name, or else by its folder's."""
    floors = told_floors()
    found = floors.get(name, floors.get(f"{name.split('.')[0]}."))
    assert found is not None, f"ARCHITECTURE.md says nothing of {name}"
    return found


@pytest.mark.parametrize("name", [name for name in INSIDE if name != "__main__"])
def test_the_architecture_puts_no_module_below_what_it_imports(name: str) -> None:
    for target in imported_modules(name):
        assert told_floor(target) <= told_floor(name), f"{name} imports {target}"


@pytest.mark.parametrize("name", [name for name in INSIDE if name.startswith("dqn")])
def test_learner_knows_no_robot(name: str) -> None:
    strangers = [t for t in imported_modules(name) if t != "config" and not t.startswith("dqn")]
    assert not strangers, f"{name} imports {strangers}"


@pytest.mark.parametrize("name", filter(needs_no_jax, INSIDE))
def test_module_needs_no_jax(name: str) -> None:
    used = {target.split(".")[0] for target in imported(name)} & JAX
    assert not used, f"{name} imports {used}"
    assert "mujoco.mjx" not in imported(name)


@pytest.mark.parametrize("name", filter(needs_no_jax, INSIDE))
def test_module_needs_no_module_that_needs_jax(name: str) -> None:
    for target in imported_modules(name):
        assert needs_no_jax(target), f"{name} imports {target}"
