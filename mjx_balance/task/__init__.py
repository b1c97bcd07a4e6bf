"""The control problem as pure functions over arrays.

Every function takes its array library from its arguments, so that the same code
runs on NumPy arrays (plain-MuJoCo evaluation) and on JAX arrays (MJX training).
None of them knows an engine. Leading dimensions, written `...`, are batches.
"""

from typing import Any, TypeAlias

Array: TypeAlias = Any
"""A NumPy or JAX array; functions say the shape and unit they expect."""
