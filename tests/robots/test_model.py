"""Makers' models as they really are: what is odd in them is mended and said, or refused."""

import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest
from fixtures import bodies
from fixtures.bodies import inertial

from mjx_balance.robots.build import Build, build
from mjx_balance.robots.draft import draft, sketch
from mjx_balance.robots.model import model_path, read_model
from mjx_balance.robots.schema import RobotError, parse_robot_file

Edits = list[tuple[str, str]]
TOTAL = 15.2  #: mass of `bodies.urdf_text`, kg
LEGS = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}


def written(folder: Path, model: str) -> Path:
    """The file of a model, URDF or MJCF."""
    path = folder / ("model.urdf" if "<robot" in model else "model.xml")
    path.write_bytes(model.encode(errors="surrogateescape"))
    return path


def draft_of(folder: Path, model: str) -> str:
    path = written(folder, model)
    return draft(path.name, path)


def sketch_of(folder: Path, model: str, strip: Sequence[str] = ()) -> tuple[str, list[str]]:
    path = written(folder, model)
    return sketch(path.name, path, strip)


def built(folder: Path, file: str, visual: bool = False) -> Build:
    """What a robot file builds."""
    return build(parse_robot_file(file, folder / "drafted.toml"), visual)


def drafted(folder: Path, model: str, visual: bool = False) -> Build:
    """What the draft of a model builds."""
    return built(folder, draft_of(folder, model), visual)


def urdf(edits: Edits = [], root: str = "trunk") -> str:  # noqa: B006
    return bodies.edited(bodies.urdf_text(root), edits)


def walker(legs: dict[str, tuple[float, float]] = LEGS, more: str = "", shank: str = "") -> str:
    """An MJCF robot of 5 kg and 1 kg a leg; `more` is in its trunk, `shank` in every thigh."""
    limbs = "".join(
        f"""<body name="{leg}_hip" pos="{x} {y} 0"><joint name="{leg}_abduction" axis="1 0 0"
        range="-.8 .8"/><geom size=".02" mass=".3"/><body name="{leg}_thigh"
        pos="0 {np.copysign(0.06, y)} 0"><joint name="{leg}_flexion" axis="0 1 0" range="-1 3"/>
        <geom size=".02" mass=".5"/>{shank.format(leg)}<body name="{leg}_calf" pos="0 0 -.2">
        <joint name="{leg}_knee" axis="0 1 0" range="-2.7 -.8"/><geom size=".01" mass=".15"/>
        <geom name="{leg}_foot" size=".02" pos="0 0 -.2" mass=".05"/></body></body></body>"""
        for leg, (x, y) in legs.items()
    )
    return f"""<mujoco><compiler angle="radian"/><worldbody><body name="trunk"><freejoint/>
    <geom type="box" size=".2 .1 .05" mass="5"/>{more}{limbs}</body></worldbody></mujoco>"""


def with_constraint(model: str, constraint: str) -> str:
    return model.replace("</mujoco>", f"<equality>{constraint}</equality></mujoco>")


BOX = '<collision><geometry><box size="0.4 0.3 0.1"/></geometry></collision>'
EYE = '<body name="eye"><joint name="eye" type="ball"/><geom size=".02" mass=".1"/></body>'


def without_inertial(link: str, mass: float) -> tuple[str, str]:
    return f'<link name="{link}">{inertial(mass)}', f'<link name="{link}">'


def fixed(name: str, parent: str, content: str) -> tuple[str, str]:
    """An edit that fixes a link to another one."""
    joint = f'<joint name="to_{name}" type="fixed"><parent link="{parent}"/><child link="{name}"/>'
    return "</robot>", f'<link name="{name}">{content}</link>{joint}</joint></robot>'


WEIGHTLESS: dict[str, tuple[str, float, str]] = {
    "root with a hull": (
        urdf([('<link name="base"/>', f'<link name="base">{BOX}</link>')], "base"),
        TOTAL,
        "base",
    ),
    "guard of a shank": (urdf([fixed("guard", "RH_calf", BOX * 2)]), TOTAL, "guard"),
    "feet": (
        urdf([without_inertial(f"{leg}_tip", 0.04) for leg in bodies.LEGS]),
        TOTAL - 4 * 0.04,
        "LF_tip, RF_tip, LH_tip, RH_tip",
    ),
}


@pytest.mark.parametrize("kind", WEIGHTLESS)
def test_a_link_without_inertial_weighs_nothing(kind: str, tmp_path: Path) -> None:
    """A hull of 12 litres is no 12 kg of water; the notes name it, and every link's mass."""
    text, total, names = WEIGHTLESS[kind]
    got = drafted(tmp_path, text)
    assert got.robot.total_mass == pytest.approx(total)
    assert got.robot.trunk_mass == pytest.approx(6.92)
    assert got.notes[0] == f"links without <inertial> weigh nothing: {names}"
    assert f"{names.split(', ')[0]} 0," in got.notes[1] + ","
    assert "LF_thigh 1.15" in got.notes[1]


def test_a_link_that_moves_needs_a_mass(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"link 'LF_hip' moves, but neither it .* write its mass"):
        drafted(tmp_path, urdf([without_inertial("LF_hip", 0.68)]))


def test_what_is_weighed_by_volume_is_said(tmp_path: Path) -> None:
    """An MJCF box of 0.4 x 0.2 x 0.1 m without a mass weighs 8 kg there."""
    got = drafted(tmp_path, walker().replace(' mass="5"', ""))
    assert got.robot.trunk_mass == pytest.approx(8.0)
    assert got.notes[0] == "weighed by the volume of their geoms: trunk"
    assert drafted(tmp_path, walker()).notes == []


HEXAPOD = LEGS | {"ML": (0.0, 0.1), "MR": (0.0, -0.1)}


def test_six_legs_are_not_four(tmp_path: Path) -> None:
    """But are, if the file leaves two of them out."""
    with pytest.raises(RobotError, match=r"6 chains that could be legs .*: leave .* --strip NAME"):
        draft_of(tmp_path, walker(HEXAPOD))
    text, _ = sketch_of(tmp_path, walker(HEXAPOD))
    assert "# To mend: model.xml has 6 chains" in text
    with pytest.raises(RobotError, match="is in no leg"):
        built(tmp_path, text)
    text, problems = sketch_of(tmp_path, walker(HEXAPOD), ["ML_hip", "MR_hip"])
    assert problems == []
    robot = built(tmp_path, text).robot
    assert robot.total_mass == pytest.approx(9)
    assert [leg.name for leg in robot.legs] == list(LEGS)


@pytest.mark.parametrize(("z", "refused"), [(0.1, False), (-0.1, True)])
def test_an_arm_is_a_leg_where_it_reaches_the_floor(
    z: float, refused: bool, tmp_path: Path
) -> None:
    """An arm with a leg's axes, folded above the trunk or hanging beside the feet."""
    arm = "".join(
        f'<body name="arm{k}" pos=".05 0 {z}"><joint name="arm{k}" axis="{axis}"/>'
        '<geom size=".02" mass=".1"/>'
        for k, axis in enumerate(("1 0 0", "0 1 0", "0 1 0"))
    )
    text, problems = sketch_of(tmp_path, walker(more=arm + "</body>" * 3))
    assert bool(problems) == refused
    assert 'strip = ["arm0", "arm1", "arm2"]' in text


ROD = """<body name="{0}_rod"><joint name="{0}_lever" axis="0 1 0"/><geom size=".01" mass=".02"/>
</body>"""
CONSTRAINTS = {
    "knee follows hip": (
        '<joint joint1="RL_knee" joint2="RL_flexion" polycoef="0 -1 0 0 0"/>',
        "joint constraint of 'RL_knee' and 'RL_flexion'",
    ),
    "locked knee": ('<joint joint1="FR_knee"/>', "joint constraint of 'FR_knee' couples"),
    "knees alike": (
        '<tendon tendon1="left" tendon2="right"/></equality><tendon><fixed name="left"><joint '
        'joint="FL_knee" coef="1"/></fixed><fixed name="right"><joint joint="FR_knee" coef="1"/>'
        "</fixed></tendon><equality>",
        "tendon constraint of 'FL_knee' and 'FR_knee'",
    ),
    "a strut": ('<connect body1="FL_calf" body2="trunk" anchor="0 0 0"/>', "'FL_calf' and 'trunk'"),
    "feet tied": ('<weld body1="FL_calf" body2="FR_calf"/>', "'FL_calf' and 'FR_calf'"),
}


@pytest.mark.parametrize("kind", CONSTRAINTS)
def test_a_leg_whose_joints_are_coupled_is_refused(kind: str, tmp_path: Path) -> None:
    """Ours would move as the maker's cannot."""
    constraint, message = CONSTRAINTS[kind]
    with pytest.raises(RobotError, match=message):
        drafted(tmp_path, with_constraint(walker(), constraint))
    inactive = constraint.replace("/>", ' active="false"/>', 1)
    assert drafted(tmp_path, with_constraint(walker(), inactive)).notes == []


def test_a_urdfs_mimic_is_a_coupling(tmp_path: Path) -> None:
    limit = 'lower="-2.72" upper="-0.838" effort="45.4" velocity="20"/>'
    mimic = urdf([(limit, f'{limit}<mimic joint="LF_hip" multiplier="-2"/>')])
    with pytest.raises(RobotError, match="constraint of 'LF_knee' and 'LF_hip' couples"):
        drafted(tmp_path, mimic)


def test_rods_that_close_a_linkage(tmp_path: Path) -> None:
    """Their knees are driven directly where the rods are left out; the draft says how."""
    rods = "".join(f'<connect body1="{x}_rod" body2="{x}_calf" anchor="-.04 0 -.2"/>' for x in LEGS)
    model = with_constraint(walker(shank=ROD), rods)
    with pytest.raises(RobotError, match="limb of FL_abduction, FL_flexion, FL_lever, FL_knee; f"):
        draft_of(tmp_path, model)
    text, problems = sketch_of(tmp_path, model, [f"{leg}_rod" for leg in LEGS])
    assert (problems, built(tmp_path, text).notes) == ([], [])
    text, _ = sketch_of(tmp_path, model, [f"{leg}_lever" for leg in LEGS])
    with pytest.raises(RobotError, match=r"'FL_rod' and 'FL_calf' couples .* strip the rods that"):
        built(tmp_path, text)


def test_a_constraint_elsewhere_is_left_out_and_said(tmp_path: Path) -> None:
    load = '<body name="load"><geom size=".02" mass=".1"/></body>'
    text = with_constraint(walker(more=load), '<weld body1="load" body2="trunk"/>')
    notes = drafted(tmp_path, text).notes
    assert notes[0] == "the weld constraint of 'load' and 'trunk' is left out"


@pytest.mark.parametrize("model", ["spy.inner:model.xml", "spy.none:model.xml", "spy:model.xml"])
def test_a_package_is_found_without_running_it(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor its parents."""
    inner = tmp_path / "spy" / "inner"
    inner.mkdir(parents=True)
    (tmp_path / "spy" / "__init__.py").write_text("raise SystemExit('run')")
    (inner / "model.xml").write_text(walker())
    monkeypatch.syspath_prepend(str(tmp_path))
    if model.startswith("spy.inner"):
        assert model_path(model, Path()) == inner / "model.xml"
    else:
        with pytest.raises(RobotError, match=r"is not installed|there is no file"):
            model_path(model, Path())
    assert not [name for name in sys.modules if name.startswith("spy")]


def test_a_module_is_no_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The standard library's `this` prints when it is imported."""
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with pytest.raises(RobotError, match=r"'this\.x' is not installed"):
        model_path("this.x:y.xml", Path())
    assert "this" not in sys.modules


def mesh(file: str, where: str = "visual") -> str:
    return f'<{where}><geometry><mesh filename="{file}"/></geometry></{where}>'


def stl(path: Path, faces: int = 4) -> None:
    """A tetrahedron in binary STL; `faces` is what its head says."""
    corners = 0.1 * np.asarray([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    triangles = [corners[[k for k in range(4) if k != skip]] for skip in range(4)]
    record = b"".join(bytes(12) + x.tobytes() + bytes(2) for x in triangles)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(80) + faces.to_bytes(4, "little") + record)


UNREADABLE = ("package://rex/meshes/trunk.stl", "gone.obj", "trunk.dae", "ascii.stl", "lies.stl")


@pytest.mark.parametrize("file", UNREADABLE)
def test_a_mesh_that_cannot_be_read_stops_nothing(file: str, tmp_path: Path) -> None:
    """Neither as a shape to look at nor as one that touches: only our feet touch."""
    (tmp_path / "trunk.dae").write_text("<COLLADA/>")
    (tmp_path / "ascii.stl").write_text("solid trunk\n" + "facet normal 0 0 1\n" * 20)
    stl(tmp_path / "lies.stl", faces=5)
    trunk = '<link name="trunk">'
    text = urdf([(trunk, f"{trunk}{mesh(file)}{mesh(file, 'collision')}")])
    got = drafted(tmp_path, text, visual=True)
    assert got.robot.total_mass == pytest.approx(TOTAL)
    assert got.notes[0].endswith(f"no readable STL, OBJ or MSH files: {Path(file).name}")


@pytest.mark.parametrize("scheme", ["package", "model"])
@pytest.mark.parametrize("place", ["rex/meshes", "other/rex/meshes", "rex/urdf/meshes"])
def test_a_package_of_meshes_is_a_folder(place: str, scheme: str, tmp_path: Path) -> None:
    """Above the URDF, beside such a one, or the URDF's own under another name."""
    stl(tmp_path / place / "trunk.stl")
    file = UNREADABLE[0].replace("package", scheme)
    text = urdf([('<link name="trunk">', f'<link name="trunk">{mesh(file)}')])
    folder = tmp_path / ("other/urdf" if place.startswith("other") else "rex/urdf")
    folder.mkdir(parents=True, exist_ok=True)
    got = drafted(folder, text, visual=True)
    assert (got.spec.compile().nmesh, got.notes) == (1, [])


def test_pictures_that_are_missing_stop_nothing(tmp_path: Path) -> None:
    """MJCF: a texture, and a mesh on a body whose mass is written; without it, it is refused."""
    assets = """<asset><mesh name="hull" file="hull.stl"/><texture name="skin" type="2d"
    file="skin.png"/><material name="skin" texture="skin"/></asset><worldbody>"""
    text = walker(more='<geom type="mesh" mesh="hull" mass="0" contype="0" conaffinity="0"/>')
    text = text.replace("<worldbody>", assets).replace('mass="5"', 'mass="5" material="skin"')
    got = drafted(tmp_path, text, visual=True)
    assert got.notes[0].endswith("files: hull.stl")
    assert got.notes[1].endswith("no readable textures: skin.png")
    assert got.spec.compile().ntex == 0
    with pytest.raises(RobotError, match=r"mesh 'hull.stl', by which body 'trunk' is weighed"):
        drafted(tmp_path, text.replace('mesh="hull" mass="0"', 'mesh="hull"'))


def test_paths_of_assets_are_stripped_where_the_model_says(tmp_path: Path) -> None:
    """To their names, under the folders of meshes and of textures."""
    stl(tmp_path / "assets" / "hull.stl")
    imageio.imwrite(tmp_path / "assets" / "skin.png", np.zeros((4, 4, 3), np.uint8))
    assets = """<compiler strippath="true" assetdir="assets"/><asset><mesh name="hull"
    file="/home/maker/hull.stl"/><texture name="skin" type="2d" file="../maker/skin.png"/>
    <material name="skin" texture="skin"/></asset><worldbody>"""
    more = '<geom type="mesh" mesh="hull" material="skin" contype="0" conaffinity="0"/>'
    text = walker(more=more).replace("<worldbody>", assets)
    shown = drafted(tmp_path, text, visual=True).spec.compile()
    assert (shown.nmesh, shown.ntex) == (1, 1)


def test_a_texture_of_six_files_is_shown(tmp_path: Path) -> None:
    """Each a PNG of its own, in the texture folder; one of too many points is left out."""
    (tmp_path / "textures").mkdir()
    sides = ("right", "left", "up", "down", "front", "back")
    for name in sides:
        imageio.imwrite(tmp_path / "textures" / f"{name}.png", np.zeros((4, 4, 3), np.uint8))
    files = " ".join(f'file{name}="{name}.png"' for name in sides)
    assets = f"""<compiler texturedir="textures"/><asset><texture name="skin" type="cube" {files}/>
    <material name="skin" texture="skin"/></asset><worldbody>"""
    text = walker().replace("<worldbody>", assets).replace('mass="5"', 'mass="5" material="skin"')
    assert drafted(tmp_path, text, visual=True).spec.compile().ntex == 1
    bomb = tmp_path / "textures" / "up.png"
    head = bytearray(bomb.read_bytes())
    head[16:24] = (100_000).to_bytes(4) * 2
    bomb.write_bytes(head)
    assert drafted(tmp_path, text, visual=True).spec.compile().ntex == 0


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("<robot ", '<robot xmlns:xacro="http://ros.org/wiki/xacro" '), None),
        (("</robot>", '<xacro:leg name="a"/></robot>'), "is xacro, not URDF; expand it: `xacro"),
        (("</robot>", "</link></robot>"), "cannot be read: mismatched tag"),
        (("<robot ", '\n<?xml version="1.0"?>\n<robot '), None),
        (("</robot>", "<!-- \u00e9 --></robot>"), None),
        (('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/>' * 2), None),
        (('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><axis xyz="0 1 0"/>'), "element: 'axis'"),
    ],
)
def test_urdfs_as_they_are_written(
    edit: tuple[str, str], message: str | None, tmp_path: Path
) -> None:
    text = urdf([edit])
    if message is None:
        assert drafted(tmp_path, text).robot.total_mass == pytest.approx(TOTAL)
    else:
        with pytest.raises(RobotError, match=message):
            drafted(tmp_path, text)


SHAPELESS = {
    "no geometry": "<visual/>",
    "an empty geometry": "<visual><geometry/></visual>",
    "a mesh without a file": "<visual><geometry><mesh/></geometry></visual>",
    "a point": '<visual><geometry><sphere radius="0.0"/></geometry></visual>',
    "a flat plate": '<collision><geometry><box size="1 1 0"/></geometry></collision>',
}


@pytest.mark.parametrize("kind", SHAPELESS)
def test_shapes_without_a_size_are_left_out(kind: str, tmp_path: Path) -> None:
    text = urdf([('<link name="trunk">', f'<link name="trunk">{SHAPELESS[kind]}')])
    got = drafted(tmp_path, text, visual=True)
    assert got.robot.total_mass == pytest.approx(TOTAL)
    assert got.spec.compile().ngeom > 4  # feet and what shows the robot


def scaled(text: str, names: str, factor: float) -> str:
    """A URDF with the numbers of some attributes times a factor."""

    def times(match: re.Match) -> str:
        return f'{match[1]}="{" ".join(str(factor * float(x)) for x in match[2].split())}"'

    return re.sub(rf'\b({names})="([^"]*)"', times, text)


LENGTHS, MOMENTS = 'xyz(?=="[^"]*\\.)|size|radius', "i[xyz][xyz]"
UNITS = {
    "mm": (LENGTHS, 1000, "no robot is as light for its size: write masses in kg and lengths in m"),
    "cm": (LENGTHS, 100, "no robot is as light"),
    "inches": (LENGTHS, 39.37, "no robot is as light"),
    "a tenth": (LENGTHS, 0.1, "no robot is as heavy"),
    "g": (f"value|{MOMENTS}", 1000, "it weighs 1.52e.04 kg, .* no robot is as heavy"),
    "g mm^2": (MOMENTS, 1e5, "body 'trunk' of 6.92 kg has moments .*; the whole .*: write them in"),
    "limits in deg": ("lower|upper", 57.3, "look like deg, and are read as rad"),
}


@pytest.mark.parametrize("kind", UNITS)
def test_numbers_of_another_unit(kind: str, tmp_path: Path) -> None:
    names, factor, message = UNITS[kind]
    with pytest.raises(RobotError, match=message) as caught:
        drafted(tmp_path, scaled(urdf(), names, factor))
    assert len(str(caught.value)) <= 300


def test_limits_in_rad_that_are_read_as_deg(tmp_path: Path) -> None:
    """The knee's 1.9 rad are 1.9 deg, and the hip's 4 are 4."""
    with pytest.raises(RobotError, match=r'turn by 4 deg at most; .* <compiler angle="radian"/>'):
        drafted(tmp_path, walker().replace('<compiler angle="radian"/>', ""))


UNFREE = {
    "a trunk on a planar joint": (
        urdf([('name="stand" type="fixed"', 'name="stand" type="planar"')], "world"),
        "leave out its joint 'stand', or make it floating",
    ),
    "legs on the world": (
        bodies.edited(
            walker(),
            [('<body name="trunk"><freejoint/>', ""), ("</body></worldbody>", "</worldbody>")],
        ),
        "put its bodies, such as 'FL_hip', into one with a <freejoint/>",
    ),
}


@pytest.mark.parametrize("kind", UNFREE)
def test_how_to_free_a_trunk(kind: str, tmp_path: Path) -> None:
    text, message = UNFREE[kind]
    with pytest.raises(
        RobotError, match=f"no free joint; its trunk must be free to move: {message}"
    ):
        draft_of(tmp_path, text)


@pytest.mark.parametrize("knee", ["-2.7 -1.9", "-2 -1.1"])
def test_a_small_robot_stands_as_its_limits_allow(knee: str, tmp_path: Path) -> None:
    """A tenth of the walker with little room: a height in whole millimetres would leave none."""
    text = walker().replace("-2.7 -.8", knee)
    length = re.compile(r'(pos|size)="([^"]*)"')
    small = length.sub(
        lambda x: f'{x[1]}="{" ".join(str(0.1 * float(y)) for y in x[2].split())}"', text
    )
    small = re.sub('mass="([^"]*)"', lambda x: f'mass="{float(x[1]) / 20}"', small)
    robot = drafted(tmp_path, small).robot
    low, high = robot.height_range
    room = np.tan(np.radians(7)) * (robot.half_length + robot.half_track)
    assert low + room - 1e-9 <= robot.body_height <= high - room + 1e-9


def test_a_mass_below_zero(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match=r"'LF_thigh' has a mass of -1\.15 kg; it must not be neg"):
        drafted(tmp_path, urdf([('value="1.15"', 'value="-1.15"')]))


@pytest.mark.parametrize("kind", ["actuator of a tendon", "motor of a joint"])
def test_actuators_of_what_is_left_out(kind: str, tmp_path: Path) -> None:
    """Their targets are gone, and they go too."""
    tendon = '<tendon><fixed name="t"><joint joint="lift" coef="1"/></fixed></tendon>'
    motor = 'tendon="t"' if kind == "actuator of a tendon" else 'joint="lift"'
    more = f'{tendon}<actuator><motor {motor}/><motor joint="lift"/></actuator></mujoco>'
    text, problems = sketch_of(tmp_path, walker(more=ARM).replace("</mujoco>", more), ["lift"])
    assert problems == []
    assert built(tmp_path, text).robot.total_mass == pytest.approx(9)


MENDED = {
    "a plate that is a point on the diagonal": (1e-3,) * 6,
    "longer than wide, and more": (1e-3, 1e-3, 9e-3),
    "negative": (1e-3, -1e-3, 1e-3),
}


@pytest.mark.parametrize("kind", MENDED)
def test_an_impossible_accessory_is_mended(kind: str, tmp_path: Path) -> None:
    """It keeps its mass, and hardly changes the moments of the trunk."""
    text = urdf([fixed("lid", "trunk", inertial(0.1, *MENDED[kind]))])
    got = drafted(tmp_path, text)
    plain = drafted(tmp_path, urdf()).spec.compile()
    assert got.robot.total_mass == pytest.approx(TOTAL + 0.1)
    assert got.notes[0].endswith("replaced by the nearest: lid")
    added = got.spec.compile().body("trunk").inertia - plain.body("trunk").inertia
    assert np.abs(added).max() <= 0.01
    assert added.sum() > 0


def test_the_nearest_inertia(tmp_path: Path) -> None:
    """Moments 1, 2 and 5 are those of masses 3, 2 and -1 along the axes; the last becomes none.

    Without it they are 2 + 0, 3 + 0 and 3 + 2 (and 1% of the greatest, for a body has a thickness).
    """
    text = urdf([fixed("lid", "trunk", inertial(0.1, 1e-3, 2e-3, 5e-3))])
    lid = read_model(written(tmp_path, text)).spec.body("lid")
    np.testing.assert_allclose(lid.fullinertia[:3], (2e-3, 3e-3, 5e-3), atol=4e-5)
    np.testing.assert_allclose(lid.fullinertia[3:], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("moments", "mended"),
    [((0.01, 0.01, 0.0205), True), ((0.01, 0.01, 0.03), False), ((0.0, 0.0, 0.0), False)],
)
def test_a_link_that_moves_is_mended_if_it_misses_by_little(
    moments: tuple[float, ...], mended: bool, tmp_path: Path
) -> None:
    """Its third moment is the sum of the others and 2% more; 50% more is no rounding."""
    text = urdf([(inertial(1.15), inertial(1.15, *moments))])
    if mended:
        assert drafted(tmp_path, text).notes[0].endswith("by the nearest: LF_thigh")
    else:
        near = "(the nearest are 0.015., 0.015., 0.03|a box)"
        with pytest.raises(RobotError, match=f"'LF_thigh' of 1.15 kg .* can have; .*: {near}"):
            drafted(tmp_path, text)


def hinged(name: str, parent: str, content: str) -> tuple[str, str]:
    """An edit that hangs a link on another one by a joint without limits, `to_NAME`."""
    edit = fixed(name, parent, content)[1].replace('"fixed"', '"continuous"')
    return "</robot>", edit


REFUSED: dict[str, tuple[str, list[str], str]] = {
    "a lidar without a mass": (urdf([hinged("lidar", "trunk", BOX)]), ["lidar"], "'lidar' moves"),
    "its joint": (urdf([hinged("lidar", "trunk", BOX)]), ["to_lidar"], "'lidar' moves"),
    "an impossible arm": (
        urdf([hinged("arm", "trunk", inertial(0.5, 1e-3, 1e-3, 9e-3))]),
        ["arm"],
        "'arm' of 0.5 kg has",
    ),
    "an arm that is not finite": (
        urdf([hinged("arm", "trunk", inertial(0.5, 1e-3, np.inf, 1e-3))]),
        ["arm"],
        "'arm' has an inertia that is not finite",
    ),
    "a mesh that is lost": (
        walker(more='<body name="arm"><geom type="mesh" mesh="a"/></body>').replace(
            "<worldbody>", '<asset><mesh name="a" file="gone.stl"/></asset><worldbody>'
        ),
        ["arm"],
        "mesh 'gone.stl', by which body 'arm'",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_stripped_need_not_be_right(kind: str, tmp_path: Path) -> None:
    text, strip, message = REFUSED[kind]
    with pytest.raises(RobotError, match=message):
        draft_of(tmp_path, text)
    file, problems = sketch_of(tmp_path, text, strip)
    assert problems == []
    assert built(tmp_path, file).robot.total_mass == pytest.approx(TOTAL if "<robot" in text else 9)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
def test_a_mass_of_the_whole_is_shared_before_bodies_are_stripped(tmp_path: Path) -> None:
    """Of 20 kg for masses of 9 + 1, the robot keeps 18."""
    arm = '<body name="arm"><geom size=".02" mass="1"/></body>'
    text = walker(more=arm).replace("<compiler ", '<compiler settotalmass="20" ')
    file, _ = sketch_of(tmp_path, text, ["arm"])
    assert built(tmp_path, file).robot.total_mass == pytest.approx(18)


@pytest.mark.parametrize("base", ["world", "base", "odom"])
def test_a_trunk_on_a_floating_joint(base: str, tmp_path: Path) -> None:
    """Its root is no part of the robot."""
    text = urdf([('name="stand" type="fixed"', 'name="stand" type="floating"')], base)
    got = drafted(tmp_path, text)
    assert (got.robot.trunk, got.robot.total_mass) == ("trunk", pytest.approx(TOTAL))
    assert got.notes == []


@pytest.mark.parametrize("mass", [0, 1e-6])
def test_an_empty_root(mass: float, tmp_path: Path) -> None:
    """As some write it for libraries that want an inertia of every root."""
    root = f'<link name="base">{inertial(mass, *[1e-6] * 6)}</link>'
    got = drafted(tmp_path, urdf([('<link name="base"/>', root)], "base"))
    assert (got.robot.trunk, got.robot.trunk_mass) == ("base", pytest.approx(6.92, abs=1e-5))


@pytest.mark.parametrize("head", ["", '<?xml version="1.0"?>\n'])
def test_a_percent_in_a_comment_is_no_harm(head: str, tmp_path: Path) -> None:
    """In any number of them, and beside a name that looks like the begin of one."""
    comment = '<!-- kp="80%" <joint name="%n"/> --><site name="a&lt;!--"/><!-- friction=\'5 %\' -->'
    text = head + walker().replace("<freejoint/>", f"<freejoint/>{comment}")
    assert drafted(tmp_path, text).robot.total_mass == pytest.approx(9)


PERCENT = "has an attribute .*; it must have no %"
HUGE = {
    # content of the model, or of its trunk; message
    "ground": (
        '<asset><hfield name="a" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>',
        r"has a height field of 1.6e\+09 points; it must have at most",
    ),
    "made mesh": (
        '<asset><mesh name="a" builtin="supertorus" params="3000 1 1 1"/></asset>',
        "has a mesh with parameter 3000; it must be at most 200",
    ),
    "nested repetition": (
        '<replicate count="2000"><replicate count="2000"><site/></replicate></replicate>',
        r"repeats elements up to 4e\+06 times",
    ),
    "hidden repetition": ('<replicate sep=">" count="&#57;99999"/>', "repeats elements"),
    "bodies": ("<body/>" * 100_000, "has 1000.. times <body; it may have 1000"),
    "sites": ("<site/>" * 100_000, "has 1000.. times <; it may have 40000"),
    "repeated bodies": ('<replicate count="1001"><body/></replicate>', "bodies; it must have at"),
    "name": ('<site name="a\udcff"/>', "has a name among its sites that is not UTF-8"),
    "pipe": ('<include file="pipe"/>', "includes '.*pipe', which is no regular file"),
    "megabytes": (f"<!--{'x' * 2**24}-->", "has more than 16 MiB of XML"),
    "format": ('<site class="%s%n"/>', PERCENT),
    "format after no comment": ('<site class="<!--"/><site class="%n"/><!-- -->', PERCENT),
    "format in a quote": ("<site name='\"' class='<!--'/><site class='%n'/><!-- -->", PERCENT),
    "format after other marks": ('<![CDATA[ > <!-- ]]><site class="%n"/><!-- -->', PERCENT),
    "hidden format": ("<site class='&#37;n'/>", PERCENT),
    "plugin": ('<plugin plugin="mujoco.elasticity.cable"/>', "needs a plugin of MuJoCo, which"),
}


@pytest.mark.parametrize("kind", HUGE)
def test_a_model_that_would_take_the_machine_is_refused(kind: str, tmp_path: Path) -> None:
    """In a second, and in a sentence."""
    content, message = HUGE[kind]
    place = "</mujoco>" if content.startswith("<asset") else "<freejoint/>"
    text = walker().replace(place, content + place)
    os.mkfifo(tmp_path / "pipe")
    start = time.process_time()
    with pytest.raises(RobotError, match=message) as caught:
        draft_of(tmp_path, text)
    assert time.process_time() - start < 3
    assert len(str(caught.value)) <= 300
    assert str(caught.value).isprintable()


LOTS = "".join(f'<!ENTITY x{k} "{f"&x{k - 1};" * 10}">' for k in range(1, 9))


@pytest.mark.parametrize(
    ("head", "content", "message"),
    [
        ("", "<a>" * 5000 + "</a>" * 5000, "nested too deep"),
        (f'<!DOCTYPE robot [<!ENTITY x0 "x">{LOTS}]>', "<a>&x8;</a>", "cannot be read: limit"),
    ],
    ids=["nested", "entities"],
)
def test_xml_that_would_take_the_machine(
    head: str, content: str, message: str, tmp_path: Path
) -> None:
    """Elements in elements, or a short line that stands for 100 MB."""
    with pytest.raises(RobotError, match=message):
        drafted(tmp_path, head + urdf([("</robot>", f"{content}</robot>")]))


def test_nothing_is_written_beside_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo warns of NaN in a log file."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RobotError, match=r"model.xml"):
        draft_of(tmp_path, walker().replace('size=".2 .1 .05"', 'size=".2 .1 nan"'))
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]


LARGE = {
    "user fields": '<size nuser_geom="2000000000" nuser_body="2000000000"/>',
    "user data": '<size nuserdata="500000000"/>',
    "keyframes": '<size nkey="100000000"/>',
    "memory": '<size memory="1000G"/>',
    "constraints": '<size njmax="2000000000" nconmax="2000000000"/>',
    "picture": (
        '<asset><texture name="a" type="2d" builtin="flat" width="40000" height="40000"/>'
        '<material name="a" texture="a"/></asset>'
    ),
    "sensor": '<sensor><user dim="500000000"/></sensor>',
}


@pytest.mark.parametrize("kind", LARGE)
def test_what_is_not_the_robots_takes_no_memory(kind: str, tmp_path: Path) -> None:
    text = walker().replace("</mujoco>", f"{LARGE[kind]}</mujoco>")
    start = time.process_time()
    assert drafted(tmp_path, text).robot.total_mass == pytest.approx(9)
    assert time.process_time() - start < 3


ARM = """<body name="lift" pos=".1 0 .05"><joint name="lift" type="slide" axis="0 0 2" ref=".1"/>
<geom size=".02" mass=".3"/><body name="arm" pos=".1 0 .1" euler=".3 .2 .1"><joint name="shoulder"
axis="0 3 1" pos="0 0 .05" ref=".4"/><geom size=".02" pos="0 .1 .2" mass=".5"/></body></body>"""


def test_an_arm_is_fixed_where_the_file_says(tmp_path: Path) -> None:
    """Every mass is where MuJoCo's kinematics of the whole model put it."""
    whole = mujoco.MjModel.from_xml_string(walker(more=ARM))
    data = mujoco.MjData(whole)
    data.qpos[:3], data.qpos[whole.joint("lift").qposadr[0]] = 0, -0.05
    data.qpos[whole.joint("shoulder").qposadr[0]] = 1.7
    mujoco.mj_forward(whole, data)
    text = draft_of(tmp_path, walker(more=ARM))
    assert 'strip = ["lift", "shoulder"]' in text
    places = '{ joint = "lift", at = -0.05 }, { joint = "shoulder", at = 1.7 }'
    fixed = built(tmp_path, text.replace('"lift", "shoulder"', places)).spec.compile()
    posed = mujoco.MjData(fixed)
    mujoco.mj_forward(fixed, posed)
    np.testing.assert_allclose(posed.body("trunk").subtree_com, data.body("trunk").subtree_com)
    parts = [whole.body(name).id for name in ("trunk", "lift", "arm")]
    centre = np.average(data.xipos[parts], axis=0, weights=whole.body_mass[parts])
    np.testing.assert_allclose(posed.body("trunk").xipos, centre, atol=1e-12)


def test_a_draft_fixes_joints_where_the_keyframe_has_them(tmp_path: Path) -> None:
    """At `home`, or else the first; by name alone where that is the model's zero."""
    legs = "0 .7 -1.4 " * 4
    keys = "".join(
        f'<key name="{name}" qpos="0 0 .3 1 0 0 0 {arm} {legs}"/>'
        for name, arm in (("up", "0 0"), ("home", ".1 -1.25"))
    )
    model = walker(more=ARM).replace("</mujoco>", f"<keyframe>{keys}</keyframe></mujoco>")
    at_home = 'strip = ["lift", { joint = "shoulder", at = -1.25 }]'
    assert at_home in draft_of(tmp_path, model)
    at_first = 'strip = [{ joint = "lift", at = 0 }, { joint = "shoulder", at = 0 }]'
    assert at_first in draft_of(tmp_path, model.replace('name="home"', 'name="a"'))


@pytest.mark.parametrize("strip", ["lift", "arm", "shoulder", "eye"])
def test_a_draft_strips_a_model_with_a_keyframe(strip: str, tmp_path: Path) -> None:
    """Whatever it strips, what is left is fixed where the keyframe of the whole has it."""
    model = walker(more=f"{EYE}{ARM}")
    whole = mujoco.MjModel.from_xml_string(model)
    qpos = whole.qpos0.copy()
    at = {"lift": 0.25, "shoulder": -1.25}
    for name, value in at.items():
        qpos[whole.joint(name).qposadr] = value
    numbers = " ".join(map(str, qpos))
    key = f'<keyframe><key name="home" qpos="{numbers}"/></keyframe>'
    text, problems = sketch_of(tmp_path, model.replace("</mujoco>", f"{key}</mujoco>"), [strip])
    assert problems == []
    gone = {"lift": ("lift", "arm", "shoulder"), "arm": ("arm", "shoulder")}.get(strip, (strip,))
    for name, value in at.items():
        assert (f'{{ joint = "{name}", at = {value} }}' in text) == (name not in gone)
    assert (', "eye"' in text) == (strip != "eye")
    built(tmp_path, text)


def test_a_ball_is_fixed_nowhere_else(tmp_path: Path) -> None:
    text = draft_of(tmp_path, walker(more=EYE))
    text = text.replace('strip = ["eye"]', 'strip = [{ joint = "eye", at = 1.0 }]')
    with pytest.raises(RobotError, match="strip fixes 'eye' at 1; it is no hinge or slide"):
        built(tmp_path, text)


def test_a_robot_without_shapes_is_a_stick_figure(tmp_path: Path) -> None:
    """Sticks from joint to joint and to the feet; thigh and calf are 0.213 m long."""
    text = urdf([('<collision><geometry><box size="0.3 0.1 0.1"/></geometry></collision>', "")])
    shown = drafted(tmp_path, text, visual=True).spec.compile()
    hidden = drafted(tmp_path, text).spec.compile()
    sticks = shown.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    assert (sticks.sum(), hidden.ngeom) == (16, 4)
    lengths = np.unique(2 * shown.geom_size[sticks, 1].round(4))
    np.testing.assert_allclose(lengths, (0.0955, np.hypot(0.193, 0.0465), 0.213), atol=2e-4)
    assert not shown.geom_contype[sticks].any()
    np.testing.assert_allclose(shown.body_mass, hidden.body_mass)


def test_small_feet_of_small_calves(tmp_path: Path) -> None:
    """A calf of 50 mm that ends in no sphere has a foot of an eighth, not of 20 mm."""
    fixed = (
        '"{0}_tip" type="fixed"><parent link="{0}_calf"/><child link="{0}_tip"/><origin xyz="0 0 '
    )
    tips = [(f"{x}-0.213", f"{x}-0.05") for x in map(fixed.format, bodies.LEGS)]
    balls = [('<sphere radius="0.022"/>', '<box size="0.001 0.001 0.001"/>')] * 4
    assert "foot_radius = 0.0063" in draft_of(tmp_path, urdf(tips + balls))


def test_a_mass_that_no_body_of_its_size_has(tmp_path: Path) -> None:
    """100 kg with moments of 0.03 kg m^2 is a ball of 16 mm; ours weighs 6.92 in the trunk."""
    text = urdf([fixed("head", "trunk", inertial(100.0, 0.03, 0.03, 0.03))])
    notes = drafted(tmp_path, text).notes
    assert notes[0] == "denser than any metal, by their moments of inertia: head 100 kg"


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ([('name="LF_knee"', 'name="LF_hip"')], "repeated name 'LF_hip' in joint"),
        ([('xyz="0 0 -0.213"', 'xyz="0 0 -1e308"')], "a body_pos above 1e"),
        ([('xyz="0 0 -0.213"', 'xyz="0 nan 0"')], "a body_pos above 1e"),
        ([('<mass value="6.92"/>', '<mass value="inf"/>')], "has a body_mass above 1e"),
    ],
)
def test_broken_models_end_in_a_sentence(edits: Edits, message: str, tmp_path: Path) -> None:
    """Found by tests/fuzz."""
    with pytest.raises(RobotError, match=message):
        drafted(tmp_path, urdf(edits))


def test_a_name_that_no_file_can_have() -> None:
    with pytest.raises(RobotError, match=r"there is no file .*xxx\.\.\.$") as caught:
        model_path("x" * 5000, Path())
    assert len(str(caught.value)) <= 300
