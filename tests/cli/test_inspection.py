"""`robot check` says what a robot is and can do."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjx_balance.cli import inspection
from mjx_balance.cli.inspection import TiltTest, describe, inspect, problems, tilt_board
from mjx_balance.robots.measure import UNLIMITED
from mjx_balance.sim.scene import Scene


@pytest.fixture(scope="module")
def spot() -> tuple[Scene, TiltTest]:
    return inspect("spot")


def test_the_tilted_robot_is_where_geometry_puts_it(spot: tuple[Scene, TiltTest]) -> None:
    """The board at 7 deg on both axes, all feet on it, the body level."""
    scene, got = spot
    data = mujoco.MjData(scene.model)
    data.qpos[:] = got.qpos
    mujoco.mj_kinematics(scene.model, data)
    np.testing.assert_allclose(np.abs(np.degrees(got.qpos[scene.board_qpos])), 7.0, atol=0.1)
    board = data.body("board/board")
    for leg in scene.robot.legs:
        centre = board.xmat.reshape(3, 3).T @ data.geom(f"robot/{leg.foot}").xpos
        assert centre[2] == pytest.approx(scene.robot.foot_radius, abs=2e-3)
    assert got.tilt < 0.5
    assert got.creep < 0.005


def test_torques_are_shares_of_the_limits(spot: tuple[Scene, TiltTest]) -> None:
    """With limits twice as high, half the shares."""
    scene, got = spot
    strong = dataclasses.replace(scene, model=scene.model.__copy__())
    strong.model.actuator_forcerange[scene.leg_ctrl] *= 2
    np.testing.assert_allclose(tilt_board(strong).torque_share, got.torque_share / 2, atol=1e-9)
    assert 0.05 < got.torque_share.max() < 1


def test_what_is_said_of_a_robot(spot: tuple[Scene, TiltTest]) -> None:
    lines = describe(*spot)
    assert lines[0] == "spot: 50.34 kg, of which the trunk 32.86"
    assert lines[1] == "stands at 542 mm; its legs reach from 176 mm to 691 mm"
    assert "limits 135.278 N m (abduction, hip), 135.278 N m (knee)" in lines[2]
    assert lines[4].split("  ")[1:] == [
        "FL",
        "front left",
        "foot 298 mm ahead, 166 mm to the left; thigh 321 mm, calf 336 mm; knee backward; "
        "+FL_hip_joint +FL_thigh_joint +FL_calf_joint",
    ]
    assert "hind right" in lines[7]
    assert "foot 298 mm behind, 166 mm to the right" in lines[7]
    assert "turn the trunk by 4.45 deg/s, 1.27 times the board's 3.5" in lines[9]
    assert "the legs can level 17.8 deg on both axes at once" in lines[10]
    share = re.search(
        r"stands still, level to 0\.\d+ deg; .* takes (\d+)% of its torque", lines[11]
    )
    assert share
    assert int(share[1]) == round(100 * spot[1].torque_share.max())
    sliding = describe(spot[0], spot[1]._replace(creep=0.023))[11]
    assert "slides by 23 mm/s" in sliding
    late = dataclasses.replace(spot[0].robot, command_delay=0.0125)
    line = describe(dataclasses.replace(spot[0], robot=late), spot[1])[2]
    assert line == lines[2].replace("obey after 4 ms", "obey after 12.5 ms") != lines[2]
    prompt = dataclasses.replace(spot[0].robot, command_delay=0.0)
    line = describe(dataclasses.replace(spot[0], robot=prompt), spot[1])[2]
    assert line == lines[2].replace("; obey after 4 ms", "")


def test_signs_and_bends_are_said() -> None:
    scene, got = inspect("mini_cheetah")
    assert "knee backward; +FL_hip_joint -FL_thigh_joint -FL_calf_joint" in describe(scene, got)[4]


def leaning(bodies: Any, folder: Path, y: float) -> tuple[Scene, TiltTest]:
    """Our robot with its trunk's weight off to one side."""
    spec = bodies.our_spec()
    spec.body("trunk").ipos = [0.02, y, 0]
    spec.compile()
    (folder / "model.xml").write_text(spec.to_xml())
    (folder / "maker.toml").write_text(bodies.file_text(Path("model.xml")))
    return inspect(str(folder / "maker.toml"))


def test_the_board_is_turned_every_way(bodies: Any, tmp_path: Path) -> None:
    """A robot and its mirror image have as much torque left, in the mirrored legs."""
    one, other = (leaning(bodies, tmp_path, y)[1] for y in (0.04, -0.04))
    mirrored = other.torque_share[[1, 0, 3, 2]]
    np.testing.assert_allclose(one.torque_share, mirrored, atol=0.01)
    assert one.tilt == pytest.approx(other.tilt, abs=0.01)
    assert one.creep == pytest.approx(other.creep, abs=1e-3)


def test_the_worst_way_counts(
    spot: tuple[Scene, TiltTest], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each servo's torque, of tilt and of creep; the picture is of the greatest torque."""

    def one(scene: Scene, ways: np.ndarray) -> TiltTest:
        share = np.zeros((4, 3))
        share[1, 2], share[3, 0] = (0.5, 0.1) if ways[0] > 0 else (0.2, 0.4)
        return TiltTest(share, 1.0 + ways[1], 2.0 - ways[1], ways)

    monkeypatch.setattr(inspection, "_tilt_board", one)
    got = tilt_board(spot[0])
    assert (got.torque_share[1, 2], got.torque_share[3, 0]) == (0.5, 0.4)
    assert (got.tilt, got.creep, got.qpos[0]) == (2.0, 3.0, 1)


def test_what_does_not_hold_is_said(spot: tuple[Scene, TiltTest]) -> None:
    """Falling begins at 6 deg; a servo at its limit holds no more."""
    scene, got = spot
    assert problems(scene, got) == []
    fallen = got._replace(tilt=6.2)
    assert problems(scene, fallen) == [
        "robot spot does not hold itself level at 7 deg on both axes: its body tilts to 6.2 deg, "
        "and 6 is a fall"
    ]
    share = np.zeros((4, 3))
    share[2, 1] = 0.985
    assert problems(scene, got._replace(torque_share=share, tilt=6.0)) == []
    share[2, 1] = 0.995
    spent = problems(scene, got._replace(torque_share=share))
    assert len(spent) == 1
    assert "no torque left at 7 deg on both axes: 'RL_thigh_joint' takes" in spent[0]


def test_torques_that_nobody_limits_are_asked_for(spot: tuple[Scene, TiltTest]) -> None:
    scene, got = spot
    robot = dataclasses.replace(scene.robot, knee_torque=UNLIMITED)
    line = describe(dataclasses.replace(scene, robot=robot), got)[11]
    assert "its model has no torque limits: set hip_torque and knee_torque, in N m" in line
    assert "%" not in line


def test_what_the_stance_can_bear() -> None:
    """A pendulum tips over the nearest edge of the feet's rectangle from d sqrt(g / h)."""
    scene, got = inspect("quadruped")
    model, data = scene.model, mujoco.MjData(scene.model)
    data.qpos[:] = scene.stance.qpos
    mujoco.mj_kinematics(model, data)
    parts = [k for k in range(model.nbody) if model.body(k).name.startswith("robot/")]
    com = np.average(data.xipos[parts], axis=0, weights=model.body_mass[parts])
    feet = np.asarray([data.geom(f"robot/{leg.foot}").xpos for leg in scene.robot.legs])
    (back, right, _), (front, left, _) = feet.min(axis=0), feet.max(axis=0)
    edge = min(com[0] - back, front - com[0], com[1] - right, left - com[1])
    speed = edge * np.sqrt(9.81 / com[2])
    line = describe(scene, got)[12]
    assert f"it cannot bear pushes above {speed:.2f} m/s (suite push: up to 0.40)" in line
    assert f"{1000 * com[2]:.0f} mm above the board" in line
    assert "mm behind and 0 mm" in line


def test_torques_that_no_robot_has_are_said(spot: tuple[Scene, TiltTest]) -> None:
    """Spot's weight at its leg's length is 50.34 * 9.81 * 0.6575 = 325 N m."""
    scene, got = spot
    assert not [line for line in describe(scene, got) if line.startswith("warning")]
    robot = dataclasses.replace(scene.robot, knee_torque=3250.0)
    lines = describe(dataclasses.replace(scene, robot=robot), got)
    assert lines[-1].startswith("warning: knee_torque is 3250 N m, 10 times the robot's weight")


def test_places_are_seen_from_the_trunks_origin(spot: tuple[Scene, TiltTest]) -> None:
    """Though it lies behind the hind legs."""
    scene, got = spot
    legs = [dataclasses.replace(leg, x=leg.x + 0.4) for leg in scene.robot.legs]
    robot = dataclasses.replace(scene.robot, legs=tuple(legs))
    lines = describe(dataclasses.replace(scene, robot=robot), got)
    assert "RL  hind left   foot 102 mm ahead, 166 mm to the left" in lines[6]
