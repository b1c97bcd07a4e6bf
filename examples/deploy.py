"""A policy at work as on a robot: plain MuJoCo at 250 Hz and `mjx_balance/runtime.py`.

python examples/deploy.py best
"""

import argparse
from collections import deque

import mujoco
import numpy as np

from mjx_balance.evaluation.rollout import policy_scene
from mjx_balance.evaluation.suites import draw_suite
from mjx_balance.policy.file import PolicyError, find_policy, load_policy
from mjx_balance.runtime import Controller, State
from mjx_balance.task.attitude import body_tilt
from mjx_balance.task.tilt import board_angle

SECONDS = 20.0


def main() -> None:
    """Balances on a board that tilts on both axes at once, and prints the mean tilt."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("policy", help="file, run folder, or name of a shipped policy")
    parser.add_argument("--robot", help="its robot, if not shipped: TOML file or menagerie:NAME")
    args = parser.parse_args()
    try:
        path = find_policy(args.policy)
        scene = policy_scene(load_policy(path), args.robot)  # the policy itself runs below
    except PolicyError as error:
        parser.error(str(error))
    model, stance, task = scene.model, scene.stance, scene.task
    data = mujoco.MjData(model)
    data.qpos, data.qacc_warmstart = stance.qpos, stance.qacc_warmstart
    data.sensordata[scene.imu] = stance.imu
    boards = draw_suite(scene.task, scene.robot, "corner", 1, SECONDS, seed=0).scenario
    controller = Controller(path, clock=lambda: data.time)
    delay = round(scene.robot.command_delay / task.sim_dt)  # physics steps until the servos obey
    standing = controller.targets + stance.leg_trim
    commands: deque[np.ndarray] = deque([standing] * delay, maxlen=1 + delay)
    tilts = []
    while data.time < SECONDS:
        gyro, accelerometer = np.split(data.sensordata[scene.imu], 2)
        targets = controller.step(data.qpos[scene.leg_qpos], gyro, accelerometer)
        commands.append(targets + stance.leg_trim)
        data.ctrl[scene.leg_ctrl] = commands[0]
        board = board_angle(task, boards, np.array([data.time + task.sim_dt]))[0]
        data.ctrl[scene.board_ctrl] = np.radians(board)
        mujoco.mj_step(model, data)
        tilts.append(body_tilt(data.qpos[scene.trunk_quat]))
    if controller.state is State.HOLDING:
        print(f"held: {controller.reason}")
    print(f"mean tilt {np.mean(tilts):.3f} deg, greatest {np.max(tilts):.3f} deg in {SECONDS:g} s")


if __name__ == "__main__":
    main()
