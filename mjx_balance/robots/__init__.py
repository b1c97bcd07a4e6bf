"""Robots: TOML files, and the bodies and numbers that are built from them."""

from pathlib import Path

SHIPPED = Path(__file__).resolve().parent
OURS = ("quadruped", "quadruped_soft")


def shipped() -> list[str]:
    """Returns the names of the robots whose files are part of this package."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))
