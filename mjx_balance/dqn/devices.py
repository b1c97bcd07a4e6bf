"""The one mesh axis of the program, seen from inside: what each device does by itself."""

import jax

AXIS = "devices"


def device_key(key: jax.Array) -> jax.Array:
    """A different key on every device."""
    return jax.random.fold_in(key, jax.lax.axis_index(AXIS))
