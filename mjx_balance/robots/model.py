"""Finds, bounds, reads and mends a maker's model; nothing of it is run, and nothing imported."""

import collections
import contextlib
import html
import importlib.util
import math
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from mjx_balance.errors import MESSAGE, how_to_install, quote, shorten
from mjx_balance.robots import urdf
from mjx_balance.robots.robot import MOST
from mjx_balance.robots.schema import RobotError

JOINT_ACTUATORS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
FRESH = mujoco.MjSpec()  #: MuJoCo's own defaults, for elements that we add to a maker's model
REMOVED = (
    *("sensors", "excludes", "pairs", "equalities", "tuples", "numerics", "texts", "tendons"),
    *("skins", "flexes", "lights", "cameras", "hfields"),
)
"""Elements of the maker's model that are removed; what refers to others goes before those."""
SIZES = ("nkey", "nconmax", "njmax", "nuserdata", "memory")
SIZES += tuple(name for name in dir(FRESH) if name.startswith("nuser_"))

BOUNDED = ("body_pos", "body_ipos", "body_mass", "body_inertia", "geom_pos", "geom_size")
BOUNDED += ("site_pos", "jnt_pos", "mesh_vert", "actuator_gear", "actuator_gainprm")
"""Fields of a compiled model that must not exceed `MOST`, in SI units."""

MAX_TEXT = 2**24  #: greatest size of a model's XML, with all that it includes, bytes
MAX_COPIES = 10_000  #: greatest product of the counts that an XML asks to repeat elements by
MAX_PARAMETER = 200  #: greatest parameter of a mesh that MuJoCo makes, such as its resolution
MAX_TAGS = 20_000  #: greatest number of elements in the XML
MAX_BODIES = 1_000  #: greatest number of bodies, and of joints
MAX_ELEMENTS = 10_000  #: greatest number of geoms, of sites and so on
MAX_MESH = 2**28  #: greatest size of a mesh file, bytes
MAX_FACES = 200_000  #: of an STL file; MuJoCo reads no more
MAX_PIXELS = 2**24  #: of a texture or height field
MAX_DENSITY = 20_000  #: greatest plausible density of a body, kg / m^3
HEAVY = 0.3  #: mass from which a body's density is looked at, kg
SLIGHT = 0.05
"""Greatest share of a moment of inertia by which it may exceed the sum of the other two, and be
mended; CAD programs round, and drop parts, by as much."""


class Coupling(NamedTuple):
    """An equality constraint of the maker's model, which ours has not."""

    kind: str
    ends: tuple[tuple[str, str], ...]  #: kind and name of the elements that it couples


class Model(NamedTuple):
    """A maker's model, with everything removed that is neither robot nor shown."""

    spec: mujoco.MjSpec
    couplings: tuple[Coupling, ...]
    notes: list[str]  #: what was mended or left out, one sentence each


def scene_dir() -> Path:
    """Returns the folder of our MJCF files, in the package or, in a checkout, beside it."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "scenes"
    return installed if installed.is_dir() else package.parent / "scenes"


def model_path(model: str, folder: Path) -> Path:
    """Finds a model file.

    Args:
      model: `RobotFile.model`.
      folder: folder that a relative path starts from.

    Raises:
      RobotError: if there is none.
    """
    where, colon, inside = model.partition(":")
    if not colon or len(where) == 1:  # no prefix, or the letter of a Windows drive
        path = folder / model
    elif where == "scenes":
        path = scene_dir() / inside
    elif where == "menagerie":
        path = _menagerie(inside)
    else:
        path = _package(where, model) / inside
    if not os.path.isfile(path):  # False for a name that no file can have
        raise RobotError(f"model is {quote(model)}, but there is no file {shorten(path, MESSAGE)}")
    return path


def _package(name: str, model: str) -> Path:
    """Folder of an installed Python package, which is not imported, and neither are its parents."""
    first, *inner = name.split(".")
    try:
        spec = importlib.util.find_spec(first) if first.isidentifier() else None
    except ValueError:  # a module without a spec, such as __main__
        spec = None
    folders = (spec.submodule_search_locations if spec else None) or []
    for folder in folders:
        if all(map(str.isidentifier, inner)) and Path(folder, *inner).is_dir():
            return Path(folder, *inner)
    raise RobotError(
        f"model is {quote(model)}, but the Python package {quote(name)} is not installed; "
        "before a colon stands a package, and a file's path has none"
    )


def _menagerie(name: str) -> Path:
    try:
        import mujoco_menagerie
    except ImportError:
        raise RobotError(
            f"robot menagerie:{name} needs the package mujoco-menagerie; {how_to_install('robots')}"
        ) from None
    try:
        robot = mujoco_menagerie.get(name)
        return robot.xml(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise RobotError(f"robot menagerie:{name} cannot be had: {error}") from error


def read_model(
    path: Path, visual: bool = False, strip: Callable[[mujoco.MjSpec], None] = lambda _: None
) -> Model:
    """Reads a model file; no static body is fused.

    The root of a URDF gets a free joint if it has no joint. Links without `<inertial>` weigh
    nothing there, as a URDF has it.

    Args:
      path: MJCF or URDF.
      visual: whether a URDF's visual shapes are read.
      strip: takes out of the model what is not needed, before that is mended or refused.

    Raises:
      RobotError: if it is too large, unreadable, or a link cannot have the inertia that it has.
    """
    _check_text(path)
    with naming(f"{path.name} cannot be read"):
        return _read(path, visual, strip)


def _read(path: Path, visual: bool, strip: Callable[[mujoco.MjSpec], None]) -> Model:
    is_urdf = path.suffix.lower() in (".urdf", ".xacro")
    if is_urdf:
        spec = mujoco.MjSpec.from_string(urdf.read(path, visual))
        spec.modelfiledir = f"{path.parent}/"
    else:
        spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.discardvisual = spec.compiler.fusestatic = False  # True by default for URDF
    _check_elements(spec, path)
    couplings = tuple(_couplings(spec))
    _clean(spec)
    for root in spec.worldbody.bodies if is_urdf else ():
        if not root.joints:
            root.add_freejoint()
    strip(spec)
    notes = _weigh_links(spec) if is_urdf else []
    notes += [*_mend_inertias(spec), *_dense(spec), *_drop_unreadable(spec)]
    return Model(spec, couplings, notes)


@contextlib.contextmanager
def naming(subject: str) -> Iterator[None]:
    """Raises errors of MuJoCo, which any access to a spec may raise, as `RobotError`.

    Its warnings are dropped, or a NaN in a model would write MUJOCO_LOG.TXT.
    """
    warn = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    except RobotError:
        raise
    except (ValueError, RuntimeError, mujoco.FatalError, MemoryError) as error:
        # One line; MuJoCo's later lines name the element.
        lines = (line.strip() for line in str(error).splitlines())
        message = shorten("; ".join(line for line in lines if line), MESSAGE)
        if "mass and inertia of moving bodies" in message:
            message += "; write its mass and moments of inertia, or fix its joint by strip"
        raise RobotError(f"{subject}: {message}") from error
    finally:
        mujoco.set_mju_user_warning(warn)


def compile_model(spec: mujoco.MjSpec, subject: str = "its model") -> mujoco.MjModel:
    """Compiles a model; raises `RobotError` with MuJoCo's message about `subject`."""
    with naming(f"{subject} cannot be compiled"):
        model = spec.compile()
    for field in BOUNDED:
        if not (np.abs(getattr(model, field)) <= MOST).all():
            raise RobotError(f"{subject} has a {field} above {MOST:g}")
    return model


_TAG = re.compile(
    rb"<\s*(replicate|composite|flexcomp|mesh|hfield|include|model)\b((?:[^\"'>]|\"[^\"]*\"|'[^']*')*+)"
)
_PERCENT = re.compile(rb"=\s*(?:\"[^\"]*?(?:%|&#)[^\"]*\"|'[^']*?(?:%|&#)[^']*')")
_TOKEN = re.compile(rb"<!--.*?-->|(<(?:[^\"'>]|\"[^\"]*\"|'[^']*')*+>)", re.DOTALL)
_HEAD = re.compile(rb"\A\s*<\?xml[^<>]*\?>")
_ATTRIBUTE = re.compile(r"([\w:]+)\s*=\s*(?:\"([^\"]*)\"|'([^']*)')")


def _check_text(path: Path) -> None:
    """Bounds what reading a file can take: its size, its files' sizes, and copies of elements."""
    files, size, copies = [path], 0, 1
    for file in files:  # grows by what is included
        if not os.path.isfile(file):
            raise RobotError(f"{path.name} includes {quote(str(file))}, which is no regular file")
        size += file.stat().st_size
        if size > MAX_TEXT:
            raise RobotError(f"{path.name} has more than {MAX_TEXT >> 20} MiB of XML, the most")
        text = file.read_bytes()
        for tag, most in ((b"<body", MAX_BODIES), (b"<", 2 * MAX_TAGS)):  # MuJoCo's time is cubic
            if text.count(tag) > most:
                raise RobotError(
                    f"{path.name} has {text.count(tag)} times {tag.decode()}; it may have {most}"
                )
        _check_percent(path, text)
        for tag, values in _elements(text):
            if tag in ("include", "model"):
                places = {folder / values["file"] for folder in (path.parent, file.parent)}
                files += [
                    x for x in places - {*files} if os.path.exists(x) and not os.path.isdir(x)
                ]
            elif tag == "hfield":
                points = math.prod(_integers(f"{values['nrow'] or 0} {values['ncol'] or 0}"))
                if points > MAX_PIXELS:
                    raise RobotError(
                        f"{path.name} has a height field of {points:.3g} points; it must have at "
                        f"most {MAX_PIXELS}"
                    )
            elif tag == "mesh":
                largest = max(_integers(values["params"]), default=0)
                if values["builtin"] and largest > MAX_PARAMETER:
                    raise RobotError(
                        f"{path.name} has a mesh with parameter {largest:g}; it must be at most "
                        f"{MAX_PARAMETER}"
                    )
            else:
                copies *= math.prod(max(1, count) for count in _integers(values["count"]))
    if copies > MAX_COPIES:
        raise RobotError(
            f"{path.name} repeats elements up to {copies:.3g} times by replicate, composite or "
            f"flexcomp; at most {MAX_COPIES} times"
        )


def _elements(text: bytes) -> Iterator[tuple[str, dict[str, str]]]:
    """Elements of `_TAG` in a file, with their attributes; "" for those that they do not have."""
    for tag, attributes in _TAG.findall(text):
        pairs = _ATTRIBUTE.findall(html.unescape(attributes.decode(errors="replace")))
        values = {name: first or second for name, first, second in pairs}
        yield tag.decode(), collections.defaultdict(str, values)


def _check_percent(path: Path, text: bytes) -> None:
    """Checks that no attribute has a %.

    MuJoCo hands an error's text to printf as its format: a name with %n ends the process.
    """
    plain = _without_comments(text).decode(errors="replace").encode()
    for value in map(bytes.decode, _PERCENT.findall(plain)):
        if "%" in html.unescape(value):
            raise RobotError(f"{path.name} has an attribute {quote(value)}; it must have no %")


def _without_comments(text: bytes) -> bytes:
    """XML without its comments; with them if what else it has could hide where they begin."""
    text = _HEAD.sub(b"", text, count=1)
    if b"<?" in text or text.count(b"<!") > text.count(b"<!--"):
        return text
    return _TOKEN.sub(lambda match: match[1] or b"", text)


def _integers(text: str) -> list[int]:
    """The numbers of an attribute, rounded down; one that is none is as large as can be."""
    words = text.split()
    return [int(float(x)) if re.fullmatch(r"[-+]?[\d.]{1,9}", x) else 10**9 for x in words]


def _check_elements(spec: mujoco.MjSpec, path: Path) -> None:
    """Bounds the numbers of elements, and checks that their names are text."""
    kinds = ("bodies", "geoms", "joints", "sites", "meshes", "materials", "textures", "actuators")
    for kind in (*kinds, "keys", "plugins", *REMOVED):
        elements = list(getattr(spec, kind))
        most = MAX_BODIES if kind in ("bodies", "joints") else MAX_ELEMENTS
        if len(elements) > most:
            raise RobotError(f"{path.name} has {len(elements)} {kind}; it must have at most {most}")
        try:
            [element.name for element in elements if hasattr(element, "name")]
        except UnicodeDecodeError:
            raise RobotError(f"{path.name} has a name among its {kind} that is not UTF-8") from None
    if any(x.plugin.active for x in (*spec.bodies, *spec.geoms, *spec.meshes)):
        raise RobotError(
            f"{path.name} needs a plugin of MuJoCo, which are not loaded; leave it out"
        )


def _couplings(spec: mujoco.MjSpec) -> list[Coupling]:
    """The active equality constraints between bodies, sites and joints."""
    couplings = []
    tendons = {x.name: x for x in spec.tendons}
    for one in [x for x in spec.equalities if x.active]:
        names = [name for name in (one.name1, one.name2) if name]
        if one.type == mujoco.mjtEq.mjEQ_TENDON:
            wraps = [x.target for name in names if name in tendons for x in tendons[name].path]
            ends = [("joint", x.name) for x in wraps if isinstance(x, mujoco.MjsJoint)]
        elif one.type == mujoco.mjtEq.mjEQ_JOINT:
            ends = [("joint", name) for name in names]
        else:
            kind = "site" if one.objtype == mujoco.mjtObj.mjOBJ_SITE else "body"
            ends = [(kind, name) for name in names]
        couplings.append(Coupling(one.type.name.removeprefix("mjEQ_").lower(), tuple(ends)))
    return couplings


def _clean(spec: mujoco.MjSpec) -> None:
    """Removes what the robot is not made of, before it costs memory or stops a compilation."""
    for geom in [x for x in spec.geoms if x.type == mujoco.mjtGeom.mjGEOM_HFIELD]:
        spec.delete(geom)
    for actuator in [x for x in spec.actuators if x.trntype not in JOINT_ACTUATORS]:
        spec.delete(actuator)  # of what is removed next
    for kind in REMOVED:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for size in SIZES:
        setattr(spec, size, getattr(FRESH, size))
    for element in (*spec.bodies, *spec.joints, *spec.geoms, *spec.sites, *spec.actuators):
        element.userdata = []


def _drop_unreadable(spec: mujoco.MjSpec) -> list[str]:
    """Removes meshes and textures that cannot be read, with the geoms made of them."""
    gone = {x.name: x for x in spec.meshes if not _readable(spec, x)}
    for geom in [x for x in spec.geoms if x.meshname in gone]:
        weighs = not (geom.mass == 0 or geom.density == 0 or geom.parent.explicitinertial)
        if weighs and geom.parent.name != "world":
            raise RobotError(
                f"mesh {quote(gone[geom.meshname].file)}, by which body "
                f"{quote(geom.parent.name)} is weighed, cannot be read; supply it, or write the "
                "body's <inertial>"
            )
        spec.delete(geom)
    blank = [x for x in spec.textures if not _drawable(spec, x)]
    lost = {
        "STL, OBJ or MSH files": {mesh.file for mesh in gone.values()},
        "textures": {file for texture in blank for file in _pictures(texture)},
    }
    for mesh in gone.values():
        spec.delete(mesh)
    for texture in blank:
        for material in spec.materials:
            material.textures = ["" if x == texture.name else x for x in material.textures]
        spec.delete(texture)
    return [
        f"not shown, for they are no readable {kind}: "
        f"{', '.join(sorted({Path(x).name for x in files}))}"
        for kind, files in lost.items()
        if files
    ]


def _file(spec: mujoco.MjSpec, element: mujoco.MjsMesh | mujoco.MjsTexture, name: str) -> Path:
    """Path of an asset's file."""
    mesh = isinstance(element, mujoco.MjsMesh)
    name = Path(name).name if spec.strippath else name
    folder = element.compiler.meshdir if mesh else element.compiler.texturedir
    return Path(spec.modelfiledir, folder, name)


def _readable(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> bool:
    """Whether MuJoCo can read a mesh's file, by its size, suffix and head."""
    if not mesh.file:
        return True
    path = _file(spec, mesh, mesh.file)
    if not os.path.isfile(path) or path.stat().st_size > MAX_MESH:
        return False
    if path.suffix.lower() != ".stl":
        return bool(mesh.content_type) or path.suffix.lower() in (".obj", ".msh")
    with path.open("rb") as file:  # binary: a head of 80 bytes, the number of faces, 50 bytes each
        faces = int.from_bytes(file.read(84)[80:], "little")
    return 0 < faces <= MAX_FACES and path.stat().st_size == 84 + 50 * faces


def _pictures(texture: mujoco.MjsTexture) -> list[str]:
    """Files of a texture, which may have one for each side of a cube."""
    return [name for name in (texture.file, *texture.cubefiles) if name]


def _drawable(spec: mujoco.MjSpec, texture: mujoco.MjsTexture) -> bool:
    """Whether a texture's files exist, and it is small enough."""
    pixels = texture.width * texture.height
    for name in _pictures(texture):
        path = _file(spec, texture, name)
        if not os.path.isfile(path):
            return False
        with path.open("rb") as file:
            head = file.read(24)
        if head.startswith(b"\x89PNG"):
            pixels = max(pixels, int.from_bytes(head[16:20]) * int.from_bytes(head[20:24]))
    return pixels <= MAX_PIXELS


def _weigh_links(spec: mujoco.MjSpec) -> list[str]:
    """Takes the weight of links without `<inertial>`; MuJoCo weighs their shapes as water."""
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return []
    light = [x for x in spec.bodies[1:] if not x.explicitinertial]
    for body in light:
        for geom in body.geoms:
            geom.mass = 0
    for body in light:
        if not body.joints or body.parent.name == "world":
            continue
        if not any(x.mass for x in _rigid(body) if x.explicitinertial):
            raise RobotError(
                f"link {quote(body.name)} moves, but neither it nor what is fixed to it has an "
                "<inertial>; write its mass and moments of inertia, or leave it out by strip"
            )
    shaped = ", ".join(x.name for x in light if x.geoms)
    return [f"links without <inertial> weigh nothing: {shaped}"] if shaped else []


def _rigid(body: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """The bodies that move as one with a body, itself included."""
    while not body.joints and body.parent.name != "world":
        body = body.parent
    fixed = [body]
    for one in fixed:  # grows
        fixed += [child for child in one.bodies if not child.joints]
    return fixed


def _inertia(body: mujoco.MjsBody) -> np.ndarray:
    """Moments and products of inertia that a body says, (3, 3) kg m^2."""
    full = body.fullinertia
    return np.diag(body.inertia) if np.isnan(full[0]) else full[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def _mend_inertias(spec: mujoco.MjSpec) -> list[str]:
    """Mends moments of inertia that no body can have where that changes next to nothing.

    That is on bodies fixed to a heavier one, and where the sum of two moments misses the third by
    less than `SLIGHT`. A body's second moments of mass, half the trace less a principal moment,
    cannot be negative; the nearest inertia has 0 instead.
    """
    mended = []
    for body in [x for x in spec.bodies[1:] if x.explicitinertial and not _possible(x)]:
        matrix = _inertia(body)
        if not np.isfinite([body.mass, *matrix.ravel()]).all():
            raise RobotError(f"body {quote(body.name)} has an inertia that is not finite")
        if body.mass < 0:
            raise RobotError(
                f"body {quote(body.name)} has a mass of {body.mass:.3g} kg; it must not be negative"
            )
        moments, axes = np.linalg.eigh(matrix)
        seconds = moments.sum() / 2 - moments
        slight = moments[0] > 0 and -seconds.min() <= SLIGHT * moments[-1]
        heavier = max(x.mass for x in _rigid(body) if x.explicitinertial) > body.mass
        possible = np.maximum(seconds, max(0.01 * seconds.max(), 1e-6 * body.mass, 1e-12))
        nearest = possible.sum() - possible
        if not (slight or heavier):
            listed, near = (", ".join(f"{x:.3g}" for x in y) for y in (moments, nearest))
            remedy = (
                f"the nearest are {near}" if seconds.max() > 0 else "a box has m (b^2 + c^2) / 12"
            )
            raise RobotError(
                f"body {quote(body.name)} of {body.mass:.3g} kg has principal moments of inertia "
                f"{listed} kg m^2, which no body can have; each must be positive, and at most the "
                f"sum of the others: {remedy}"
            )
        near = axes * nearest @ axes.T
        if np.isnan(body.fullinertia[0]):
            body.inertia = near.diagonal()
        else:
            body.fullinertia = [*near.diagonal(), near[0, 1], near[0, 2], near[1, 2]]
        mended.append(body.name)
    if not mended:
        return []
    return [
        f"moments of inertia that no body can have, replaced by the nearest: {', '.join(mended)}"
    ]


def _dense(spec: mujoco.MjSpec) -> list[str]:
    """Names bodies whose moments of inertia are too small for their mass, whatever their shape.

    Of all bodies with a sum of moments, a ball has the greatest volume: its radius is
    sqrt(5 / 6 * sum / mass).
    """
    dense = []
    for body in [x for x in spec.bodies[1:] if x.explicitinertial and x.mass > HEAVY]:
        volume = 4 / 3 * np.pi * (5 / 6 * _inertia(body).trace() / body.mass) ** 1.5
        if body.mass > MAX_DENSITY * volume:
            dense.append(f"{body.name} {body.mass:.3g} kg")
    if not dense:
        return []
    return [f"denser than any metal, by their moments of inertia: {', '.join(dense)}"]


def _possible(body: mujoco.MjsBody) -> bool:
    """Whether MuJoCo takes a body's inertia."""
    probe = mujoco.MjSpec()
    alone = probe.worldbody.add_body(mass=body.mass, explicitinertial=True)
    alone.inertia, alone.fullinertia = body.inertia, body.fullinertia
    if len(_rigid(body)) == 1:  # only what moves must have a mass
        alone.add_freejoint()
    try:
        probe.compile()
    except ValueError:
        return False
    return True
