"""The control problem as pure functions over arrays.

What training and evaluation share takes its array library from its arguments, so that the same
code runs on NumPy arrays (plain-MuJoCo evaluation) and on JAX arrays (MJX training). What only
controllers and figures call (`roll_pitch`, `nearest_action`, `to_command`) is for NumPy arrays.
None of them knows an engine. Annotations give shapes; `*batch` and `...` are any leading axes.
"""

from typing import Any, TypeAlias

Array: TypeAlias = Any  #: a NumPy or JAX array, as in `Float[Array, "*batch legs"]`
