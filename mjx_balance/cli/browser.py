"""What the page of `demo/` shows, as files, and the server of `mjx-balance view --browser`. No JAX.

The page is MuJoCo in WebAssembly and a runtime in JavaScript. Its data are policy files, and one
JSON file per robot with scenes and scenarios; `data/index.json` lists them. `make demo` writes
those of the shipped policies: `python -m mjx_balance.cli.browser FOLDER`.
"""

import argparse
import contextlib
import functools
import hashlib
import http.server
import json
import re
import shutil
import sys
import tempfile
import urllib.parse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjx_balance.cli.common import ControllerArgs
from mjx_balance.config import ConfigError, TaskConfig, to_dict
from mjx_balance.errors import InputError
from mjx_balance.evaluation.controllers import ImuPD
from mjx_balance.evaluation.rollout import policy_scene, suite_scene
from mjx_balance.evaluation.suites import SUITES, SuiteError, check_seed, draw_suite, find_suite
from mjx_balance.policy.file import convert_policy, find_policy, load_policy, shipped_policies
from mjx_balance.policy.manifest import PolicyError
from mjx_balance.robots.catalogue import robot_file
from mjx_balance.robots.limits import delay_steps, greatest_incline
from mjx_balance.robots.model import model_path
from mjx_balance.sim.domain_randomization import randomized_fields
from mjx_balance.sim.scene import BOARD, ROBOT, Scene, build_spec
from mjx_balance.task.events import params_now
from mjx_balance.task.randomization import DomainParams

PAGE = Path(__file__).resolve().parents[1] / "page"
"""The built page: `demo/build.js` writes it."""
TYPES = {".js": "text/javascript", ".wasm": "application/wasm"}
BASELINES = ("pd-imu", "none")
"""Baselines that the page can run."""
SCENARIOS, SECONDS = 8, 60.0
"""Of every suite; scenario k is the one of `mjx-balance evaluate --seed 0`."""

MESH_CELLS = 18
"""Cubes along a mesh's longest side, in which one vertex is left."""
MESHES = re.compile(r"^ *<mesh .*/>\n", re.MULTILINE)
ON_BOTH, ON_FLOOR = 1, 2
"""Collision bits of what touches board and floor, and the floor alone."""


def robot_data(scene: Scene, seed: int = 0, suites: Iterable[str] = SUITES) -> dict[str, Any]:
    """What the page knows of a robot: task, scenes, gains of `pd-imu`, scenarios of the suites.

    Suites that need soft servos or a platform have a scene of their own; those that do not fit the
    robot are left out.
    """
    task, robot, file = scene.task, scene.robot, robot_file(scene.robot_source)
    pd = ImuPD(scene)
    scenes, scenarios = {"": scene_data(scene)}, {}
    for name in suites:
        try:
            own = suite_scene(scene, name)
            drawn = suite_scenarios(own, name, seed)
        except (ConfigError, SuiteError):
            continue
        key = "" if own is scene else "platform" if SUITES[name].platform else "soft"
        if key not in scenes:
            scenes[key] = scene_data(own, scene if key == "soft" else None)
        scenarios[name] = {"scene": key, "scenarios": drawn}
    meshes = "".join(re.findall(MESHES, scenes[""]["xml"]))  # they are the same in every scene
    for own in scenes.values():
        if "xml" in own:
            own["xml"] = re.sub(MESHES, "", own["xml"])
    return {
        "name": robot.name,
        "robot": to_dict(robot),
        "source": file.source,
        "license": file.license,
        "task": {
            "sim_dt": task.sim_dt,
            "sim_steps": task.sim_steps,
            "ramp_steps": task.ramp_steps,
            "fail_tilt": task.fail_tilt,
            "board_rate": task.board_rate,
            "target_period": task.target_period,
            "sea_period": task.sea_period,
            "max_incline": greatest_incline(task, robot),
            "body_height": task.body_height,
            "command_delay": delay_steps(task, robot),
            "push_scale": robot.push_scale,
        },
        "pd": {
            "gain": pd.gain.tolist(),
            "proportional": pd.proportional,
            "rate": pd.rate,
            "tau": pd.tau,
            "samples": pd.samples,
            "most": task.action_max,
            # On the grid the nearest of so many levels.
            "levels": task.action_levels if task.action == "grid" else 0,
        },
        "meshes": meshes,
        "scenes": scenes,
        "suites": scenarios,
    }


def scene_data(scene: Scene, base: Scene | None = None) -> dict[str, Any]:
    """A scene: MJCF, or the fields in which it differs from `base`; addresses, the stance."""
    stance = scene.stance
    data: dict[str, Any] = {
        "qpos": stance.qpos.tolist(),
        "qacc_warmstart": stance.qacc_warmstart.tolist(),
        "leg_trim": stance.leg_trim.ravel().tolist(),
        "imu": stance.imu.tolist(),
    }
    addresses = ("leg_qpos", "leg_ctrl", "board_qpos", "board_ctrl", "platform_qpos")
    for name in (*addresses, "platform_ctrl", "trunk_quat", "trunk_velocity"):
        data[name] = getattr(scene, name).ravel().tolist()
    data["sensors"] = scene.imu.tolist()
    if base is None:
        xml = page_xml(scene.task, scene.robot_source)
        read = mujoco.MjModel.from_xml_string(xml)
        names = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat")
        data["xml"] = xml.replace(' input="pos"', "")  # unknown to the engine in the page, 3.14
    else:
        read = base.model
        names = ("actuator_gainprm", "actuator_biasprm", "dof_damping")
    data["fields"] = changes(read, {name: getattr(scene.model, name) for name in names})
    return data


def page_xml(task: TaskConfig, robot: str) -> str:
    """The scene as MJCF in one text, with all that shows the robot.

    Unlike in the evaluation, where an episode ends with the fall, the robot's body touches board
    and floor. Its calves do not touch the board: the feet, which are on them, do.
    """
    spec = build_spec(task, robot, visual=True)
    feet = [pair.geomname1 for pair in spec.pairs]
    calves = [spec.geom(foot).parent for foot in feet]
    for geom in spec.geoms:
        if geom.name == "floor":
            geom.conaffinity = ON_BOTH | ON_FLOOR
            if task.platform:  # which heaves
                geom.pos[2] -= task.sea_height
        elif geom.name == f"{BOARD}board":
            geom.conaffinity = ON_BOTH
        elif geom.name.startswith(ROBOT):
            geom.contype = ON_FLOOR if geom.parent in calves else ON_BOTH
    _simplify_meshes(spec)
    spec.compile()
    return spec.to_xml()


def _simplify_meshes(spec: mujoco.MjSpec) -> None:
    """Puts small meshes, which are part of the MJCF, in the place of makers' files.

    All vertices in a cube of a grid become one, their mean.
    """
    if not spec.meshes:
        return
    model = spec.compile()
    for mesh in list(spec.meshes):
        k = model.mesh(mesh.name).id
        start, end = model.mesh_vertadr[k] + np.asarray((0, model.mesh_vertnum[k]))
        vertices = model.mesh_vert[start:end].astype(float)
        start, end = model.mesh_faceadr[k] + np.asarray((0, model.mesh_facenum[k]))
        faces, turn = model.mesh_face[start:end], np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.mesh_quat[k])  # the compiler has centred and turned them
        vertices = vertices @ turn.reshape(3, 3).T + model.mesh_pos[k]
        low, size = vertices.min(axis=0), np.ptp(vertices, axis=0).max() / MESH_CELLS
        cells = ((vertices - low) / size).astype(int)
        _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        means = np.zeros((len(count), 3))
        np.add.at(means, cell, vertices)
        faces = cell[faces]
        whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        small = spec.add_mesh(
            name=f"{mesh.name}_small",
            uservert=np.round(means / count[:, None], 4).ravel().tolist(),
            userface=np.unique(faces[whole], axis=0).ravel().tolist(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,  # no volume may be left
        )
        for geom in [x for x in spec.geoms if x.meshname == mesh.name]:
            geom.meshname = small.name
        spec.delete(mesh)


def changes(model: mujoco.MjModel, fields: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The numbers of fields that are others than the model's: {name: [indices, numbers]}."""
    differences = {}
    for name, values in fields.items():
        old, new = np.ravel(getattr(model, name)), np.ravel(values)
        where = np.flatnonzero(~np.isclose(old, new, rtol=1e-12, atol=1e-15))
        if len(where):
            differences[name] = [where.tolist(), new[where].tolist()]
    return differences


def suite_scenarios(scene: Scene, suite: str, seed: int) -> list[dict[str, Any]]:
    """The first scenarios of a suite, with all that is drawn for them but noise."""
    episodes = draw_suite(scene.task, scene.robot, suite, SCENARIOS, SECONDS, seed)
    scenario, start = episodes.scenario, None
    if scenario.start is not None:
        start = scene.start(scenario.start)
    scenarios = []
    for k in range(SCENARIOS):
        data: dict[str, Any] = {
            "targets": scenario.targets[k].tolist(),
            "phase": float(scenario.phase[k]),
            "rate": float(scenario.rate[k]),
        }
        if scenario.waves is not None:
            waves = scenario.waves._asdict()
            data["waves"] = {name: values[k].tolist() for name, values in waves.items()}
        if start is not None and scenario.start is not None:
            data["start"] = scenario.start[k].tolist()
            data["qpos"], data["imu"] = start.qpos[k].tolist(), start.imu[k].tolist()
        if episodes.params is not None:
            params = DomainParams(*(values[k] for values in episodes.params))
            data |= {"noise": params.imu_noise.tolist(), "delay": float(params.delay)}
            data["fields"] = changes(scene.model, randomized_fields(scene, params))
            if episodes.event is not None:
                event = type(episodes.event)(*(values[k] for values in episodes.event))
                after = randomized_fields(scene, params_now(event, params, event.due))
                data["event"] = {"due": int(event.due), "fields": changes(scene.model, after)}
        if episodes.pushes is not None:
            data["pushes"] = {name: x[k].tolist() for name, x in episodes.pushes._asdict().items()}
        if episodes.errors is not None:
            errors = episodes.errors._asdict()
            data["errors"] = {name: np.ravel(values[k]).tolist() for name, values in errors.items()}
        scenarios.append(data)
    return scenarios


def write_data(folder: Path, entries: Iterable[tuple[Path | None, Scene]], seed: int = 0) -> None:
    """Writes what the page shows into `folder/data`: policy files with their scenes, and an index.

    Without a file there are the baselines alone. `seed` draws the scenarios.
    """
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    index: dict[str, Any] = {"policies": [], "robots": {}}
    for path, scene in entries:
        content = robot_data(scene, seed)
        text = json.dumps(content, separators=(",", ":"))
        # Policies of one robot may have other tasks.
        file = f"{content['name']}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
        (data / file).write_text(text, encoding="utf-8")
        index["robots"][file] = {key: content[key] for key in ("name", "source", "license")}
        _copy_license(data, scene.robot_source)
        if path is not None:
            name = path.stem
            shutil.copyfile(path, data / f"{name}.safetensors")
            index["policies"].append({"name": name, "file": f"{name}.safetensors", "robot": file})
    (data / "index.json").write_text(json.dumps(index, indent=1), encoding="utf-8")


def _copy_license(data: Path, robot: str) -> None:
    """Copies the licence that lies beside a maker's model, which asks to go along with it."""
    file = robot_file(robot)
    text = model_path(file.model, file.folder).parent / "LICENSE"
    if text.is_file():
        shutil.copyfile(text, data / f"LICENSE-{file.name}.txt")


def shipped_scenes() -> Iterable[tuple[Path, Scene]]:
    """The shipped policies with their scenes; names policies without a robot's model on stderr."""
    for name, path in shipped_policies().items():
        try:
            yield path, policy_scene(load_policy(path))
        except PolicyError as error:
            print(f"left out: {name}, because {error}", file=sys.stderr)


def page_folder() -> Path:
    """The built page.

    Raises:
      InputError: if it has not been built.
    """
    if not (PAGE / "index.html").is_file():
        raise InputError(
            "the page is not part of this installation; `make demo` in a checkout builds it, or "
            "`make dist` a wheel with it, and both need npm"
        )
    return PAGE


def view_in_browser(args: ControllerArgs, suite: str | None, seed: int, port: int) -> int:
    """Serves the page for a policy or baseline on 127.0.0.1 until Ctrl-C; returns 0.

    `port` 0 takes a free one.

    Raises:
      InputError: if the page is not built, or policy, baseline, suite or port cannot be used.
    """
    page = page_folder()
    scene, _ = args.load()
    if suite is not None:
        find_suite(suite)
    check_seed(seed)
    if args.controller not in (None, *BASELINES):
        raise InputError(
            f"controller is {args.controller!r}; in a browser it must be {' or '.join(BASELINES)}"
        )
    with tempfile.TemporaryDirectory() as name:
        folder, path = Path(name), None
        if args.policy is not None:
            source = find_policy(args.policy)
            path = folder / f"{source.stem}.safetensors"
            convert_policy(source, path, args.action)
        write_data(folder, [(path, scene)], seed)
        query = {"policy": path.stem if path else str(args.controller)}
        query |= {} if suite is None else {"suite": suite}
        try:
            server = http.server.ThreadingHTTPServer(
                ("127.0.0.1", port), functools.partial(_Handler, page, folder)
            )
        except (OSError, OverflowError) as error:
            raise InputError(f"port is {port}; no server can listen there: {error}") from error
        with server:
            address = f"http://127.0.0.1:{server.server_port}/?{urllib.parse.urlencode(query)}"
            print(f"{address}\nCtrl-C ends it.", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                server.serve_forever()
    return 0


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Serves the page, and `/data/` from another folder."""

    def __init__(self, page: Path, data: Path, *arguments: Any) -> None:
        self._data = data
        # Python's own table asks the machine for these.
        self.extensions_map = self.extensions_map | TYPES
        super().__init__(*arguments, directory=str(page))

    def translate_path(self, path: str) -> str:
        root = self.directory
        self.directory = str(self._data) if path.startswith("/data/") else root
        try:
            return super().translate_path(path)
        finally:
            self.directory = root

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-cache")  # the next policy may have the same address
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing."""


def main() -> None:
    """Writes the data of the shipped policies into a folder, beside the page."""
    parser = argparse.ArgumentParser(description="Writes what the page of demo/ shows.")
    parser.add_argument("folder", type=Path, help="of the built page")
    write_data(parser.parse_args().folder, shipped_scenes())


if __name__ == "__main__":
    main()
