"""Writes what `balance` and `fake_robot` simulate: model, start and board motions.

python examples/robot/scene.py best --suite corner --scenarios 16
"""

import argparse
import copy
import math
from pathlib import Path

import mujoco
import numpy as np

from mjx_balance.errors import InputError
from mjx_balance.evaluation.rollout import check_fits, policy_scene, suite_scene
from mjx_balance.evaluation.suites import SUITES, draw_suite
from mjx_balance.files.run_folder import write_atomically
from mjx_balance.policy.file import load_policy
from mjx_balance.robots.limits import delay_steps
from mjx_balance.sim.scene import Scene, build_model, leg_dofs
from mjx_balance.task.kinematics import joint_angles
from mjx_balance.task.tilt import board_angle, platform_position

HERE = Path(__file__).parent
STAND_SECONDS = 10.0  #: in which a robot that lies can stand up before the board moves
IMU_NOISE = (
    0.002,
    0.02,
)  #: rad/s, m/s^2; without, a robot at rest looks like an IMU that has stopped
LOW = 0.02  #: m, above the least height of the trunk
GEAR_DAMPING = 1.0  #: of a limp leg, N m s/rad
REST_SECONDS = 3.0


def records(
    scene: Scene, suite: str, scenarios: int, duration: float, seed: int, lying: bool = False
) -> dict[str, np.ndarray]:
    """Name -> array: the model's bytes, float64 for all else.

    Raises:
      InputError: for a suite that changes more than the board and the start, or for a robot that
        lies on a tilted board.
    """
    task, model, stance = scene.task, scene.model, scene.stance
    check_fits(task, scenarios, duration, recorded=2)
    episodes = draw_suite(task, scene.robot, suite, scenarios, duration, seed)
    others = (episodes.params, episodes.pushes, episodes.errors, episodes.event)
    if SUITES[suite].soft or any(x is not None for x in others):
        raise InputError(
            f"suite is {suite}; the simulation in C++ knows boards and starts only: paper, corner, "
            "fast, steep, recover, steps, sea or platform"
        )
    if lying and episodes.scenario.start is not None:
        raise InputError(f"suite is {suite}; a robot can lie only on a board that starts level")
    time = task.sim_dt * np.arange(
        1, math.ceil(duration / task.ctrl_dt - 1e-9) * task.sim_steps + 1
    )
    board = np.radians(board_angle(task, episodes.scenario, time))
    if task.platform:
        position = platform_position(task, episodes.scenario, time)
        board = np.concatenate((board, position), axis=-1)
    start, first = scene.start(episodes.scenario.start), 0
    state = start.qpos, stance.qvel, stance.qacc_warmstart, start.imu
    if lying:
        model, state = lay_down(scene)
        first = round(STAND_SECONDS / task.sim_dt)
        board = np.pad(board, ((0, 0), (first, 0), (0, 0)))
    ctrl = np.zeros(model.nu)
    standing = joint_angles(scene.robot, np.full(len(scene.robot.legs), task.body_height))
    ctrl[scene.leg_ctrl] = standing + stance.leg_trim
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    values = {
        "episodes": scenarios,
        "steps": board.shape[1],
        "first": first,
        "fail_tilt": task.fail_tilt,
        "imu_noise": IMU_NOISE if lying else (0, 0),
        "command_delay": delay_steps(task, scene.robot),
        "trunk_quat": scene.trunk_quat[0],
        "leg_qpos": scene.leg_qpos,
        "leg_dofs": leg_dofs(model, scene.leg_ctrl),
        "leg_servos": scene.leg_ctrl,
        "board_servos": np.append(scene.board_ctrl, scene.platform_ctrl),
        "imu": scene.imu,
        "qpos": np.broadcast_to(state[0], (scenarios, model.nq)),
        "qvel": state[1],
        "qacc_warmstart": state[2],
        "still": np.broadcast_to(state[3], (scenarios, 6)),
        "ctrl": ctrl,
        "board": board,
        "end": 0,
    }
    return {"model": content} | {k: np.asarray(x, "<f8") for k, x in values.items()}


def lay_down(scene: Scene) -> tuple[mujoco.MjModel, tuple[np.ndarray, ...]]:
    """The robot lying on its belly: a model whose trunk and thighs touch the board, too.

    Returns the model, and qpos, qvel, qacc_warmstart and IMU of the robot at rest.
    """
    robot, model = scene.robot, build_model(scene.task, scene.robot_source, visual=True)
    board = model.geom("board/board").id
    for geom in range(model.ngeom):
        body = model.geom_bodyid[geom]
        if body == scene.trunk or "thigh" in model.body(body).name:
            model.geom_contype[geom] = model.body_contype[body] = 1
    model.geom_conaffinity[board] = model.body_conaffinity[model.geom_bodyid[board]] = 1
    data, root = mujoco.MjData(model), scene.trunk_quat[0] - 3
    lowest = np.full(len(robot.legs), robot.height_range[0] + LOW)
    data.qpos[scene.leg_qpos] = joint_angles(robot, lowest)
    data.qpos[root + 2] = robot.height_range[0] + 2 * LOW
    limp = copy.copy(model)
    limp.actuator_gainprm[scene.leg_ctrl, 0] = limp.actuator_biasprm[scene.leg_ctrl, 1] = 0
    limp.dof_damping[leg_dofs(model, scene.leg_ctrl)] = GEAR_DAMPING
    mujoco.mj_step(limp, data, nstep=round(REST_SECONDS / scene.task.sim_dt))
    return model, (data.qpos, data.qvel, data.qacc_warmstart, data.sensordata[scene.imu])


def main(argv: list[str] | None = None) -> None:
    """Writes the scene of a policy's evaluation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("policy", help="file, run folder, or name of a shipped policy")
    parser.add_argument("--robot", help="its robot, if not shipped: TOML file or menagerie:NAME")
    parser.add_argument("--suite", default="corner", help="as of mjx-balance evaluate")
    parser.add_argument("--scenarios", type=int, default=1)
    parser.add_argument("--duration", type=float, default=60.0, help="of a scenario, s")
    parser.add_argument("--seed", type=int, default=0, help="of the scenarios")
    parser.add_argument(
        "--lying", action="store_true", help="the robot lies on its belly; for balance --stand-up"
    )
    parser.add_argument("--out", type=Path, default=HERE / "build/scene.bin")
    args = parser.parse_args(argv)
    try:
        scene = suite_scene(policy_scene(load_policy(args.policy), args.robot), args.suite)
        size = args.scenarios, args.duration, args.seed
        arrays = records(scene, args.suite, *size, args.lying)
    except InputError as error:
        parser.error(str(error))
    parts = [f"{name} {x.nbytes}\n".encode() + x.tobytes() for name, x in arrays.items()]
    try:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(args.out, b"".join(parts))
    except OSError as error:
        parser.error(f"{args.out} cannot be written: {error.strerror}")
    print(f"{args.out}: {args.scenarios} scenarios of {args.suite}, {args.duration:g} s each")


if __name__ == "__main__":
    main()
