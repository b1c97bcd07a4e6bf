"""What every engine measures of a scene: MuJoCo's fields at each physics step -> `Motion`.

To measure more, name MuJoCo's field in `RECORDED` and add an entry to `Motion` and to `measure`.
"""

from jaxtyping import Float

from mjx_balance.sim.scene import Scene
from mjx_balance.task import Array
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.step import Motion

RECORDED = ("qpos", "sensordata")
"""Fields of MuJoCo's data that engines record at every physics step."""


def measure(
    scene: Scene, qpos: Float[Array, "*batch nq"], sensordata: Float[Array, "*batch nsensordata"]
) -> Motion:
    """Measures qpos after each physics step, and sensordata of the state before it."""
    return Motion(
        imu=sensordata[..., scene.imu],
        tilt=body_tilt(qpos[..., scene.trunk_quat]),
        joint_angles=qpos[..., scene.leg_qpos],
    )
