"""Prepares a URDF for MuJoCo: package paths, unreadable meshes, what exporters write twice."""

import os
import re
import shlex
from pathlib import Path
from xml.etree import ElementTree

from mjx_balance.errors import MESSAGE, shorten
from mjx_balance.robots.schema import RobotError


def read(path: Path, visual: bool) -> str:
    """Returns the XML of a URDF, with absolute paths of meshes.

    Args:
      path: of the URDF.
      visual: whether to keep its visual shapes.

    Raises:
      RobotError: if it is no URDF, or a xacro file.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    text = re.sub(r"<\?xml.*?\?>", "", text, count=1, flags=re.DOTALL)
    try:
        robot = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        message = shorten(error, MESSAGE)
        if "unbound prefix" in message:
            raise _xacro(path) from None
        raise RobotError(f"{path.name} cannot be read: {message}") from error
    if any("xacro" in element.tag for element in robot.iter()):
        raise _xacro(path)
    _free_trunk(robot)
    for element in (*robot.iter("joint"), *robot.iter("visual")):
        _drop_repeated(element)
    for link in robot.iter("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            if not _has_size(shape):
                link.remove(shape)
    extension = robot.find("mujoco")
    if extension is None:
        extension = ElementTree.SubElement(robot, "mujoco")
    compiler = extension.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(extension, "compiler")
    folders = (path.parent / compiler.get("meshdir", ""), path.parent)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", _mesh_file(mesh.get("filename", ""), folders))
    compiler.attrib.update(strippath="false", meshdir="")
    if visual:
        compiler.set("discardvisual", "false")
    try:
        return ElementTree.tostring(robot, encoding="unicode")
    except RecursionError:
        raise RobotError(f"{path.name}: its elements are nested too deep to be read") from None


def _free_trunk(robot: ElementTree.Element) -> None:
    """Makes what hangs on a floating joint a root, and drops the empty link that it hung on."""
    for joint in [x for x in robot.findall("joint") if x.get("type") == "floating"]:
        robot.remove(joint)
        parent = joint.find("parent")
        name = None if parent is None else parent.get("link")
        ends = [x.get("link") for k in ("joint/parent", "joint/child") for x in robot.findall(k)]
        for link in robot.findall("link"):
            if link.get("name") == name not in ends and link.find("inertial") is None:
                robot.remove(link)


def _drop_repeated(element: ElementTree.Element) -> None:
    """Drops materials but the first, and what repeats an element before it."""
    seen = set()
    for child in list(element):
        same = child.tag if child.tag == "material" else ElementTree.tostring(child).strip()
        if same in seen:
            element.remove(child)
        seen.add(same)


def _has_size(shape: ElementTree.Element) -> bool:
    """Whether a shape is a mesh of a file, or a body whose sizes are not 0."""
    names = ("filename", "radius", "length", "size")
    sizes = [x.get(name, "") for x in shape.iterfind("geometry/*") for name in names]
    return any(sizes) and all(x.strip("0.") for size in sizes for x in size.split())


def _mesh_file(name: str, folders: tuple[Path, Path]) -> str:
    """The path of a mesh, or its name if there is no such file.

    A package, or model of Gazebo, is a folder of its name above the URDF or in ROS_PACKAGE_PATH;
    or, under another name, the folder of the URDF or the one above.
    """
    scheme, _, rest = name.rpartition("://")
    package, _, inside = rest.partition("/")
    if scheme in ("package", "model"):
        above = (folders[1].absolute(), *folders[1].absolute().parents)
        roots = [x for x in above if x.name == package] + [x / package for x in above]
        roots += [Path(x) / package for x in os.environ.get("ROS_PACKAGE_PATH", "").split(":") if x]
        paths = [root / inside for root in (*roots, *above[:2])]
    else:
        name = name.removeprefix("file://")
        paths = [folder / part for folder in folders for part in (name, Path(name).name)]
    return next((str(x.absolute()) for x in paths if os.path.isfile(x)), name)


def _xacro(path: Path) -> RobotError:
    return RobotError(
        f"{path.name} is xacro, not URDF; expand it: `xacro {shlex.quote(path.name)} > robot.urdf`"
    )
