"""Makers' models and robot files with values, elements and bytes changed at random places."""

import os
import random
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures import bodies

from mjx_balance.robots.build import build
from mjx_balance.robots.draft import sketch
from mjx_balance.robots.model import scene_dir
from mjx_balance.robots.schema import RobotError, parse_robot_file, read_robot_file

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::UserWarning")]

SECONDS = 3.0  #: most that a model may take of the processor, s

NUMBERS = ("0", "-1", "1e308", "-1e308", "nan", "inf", "1e-320", "2147483647", "-2147483648")
NUMBERS += ("1e20",)
WORDS = ("", "true", "x" * 5000, "\u202e\x07", "1 2", "0 " * 10, "../../../etc/passwd", "world")
WORDS += ("trunk", "LF_hip", "&#27;[31m", "%s%n", "\u00ff", "/dev/zero", "package://a/b.stl")
ELEMENTS = (
    *("<site/>", "<joint/>", "<freejoint/>", "<body/>", "<camera/>", "<light/>"),
    *('<geom type="mesh" mesh="x"/>', '<geom size="1e-300"/>', '<geom type="sdf" size="1"/>'),
    '<body name="trunk"/>',
    '<inertial pos="0 0 0" mass="1e300" diaginertia="1 1 1"/>',
    '<frame euler="1e300 0 0"><geom size="1"/></frame>',
    '<composite type="cable" count="10 1 1" size="1"/>',
    '<flexcomp name="f" type="grid" count="5 5 5" spacing=".1 .1 .1" mass="1" radius=".01"/>',
    '<replicate count="10" euler="0 0 36"><geom size=".1"/></replicate>',
    '<attach model="x" body="y" prefix="z"/>',
    '<plugin plugin="mujoco.pid"/>',
    '<geom type="hfield" hfield="z"/>',
    '<geom fromto="0 0 0 0 0 0" size=".1" type="capsule"/>',
    '<link name="a"/>',
    '<joint name="j" type="floating"><parent link="trunk"/><child link="a"/></joint>',
    '<mujoco><compiler balanceinertia="true" boundmass="1e300"/></mujoco>',
    '<equality><joint joint1="LF_knee" joint2="RF_knee"/><weld body1="trunk"/></equality>',
    '<keyframe><key qpos="1 2"/></keyframe>',
)


def changed(text: str, rng: random.Random) -> str:
    """The text of a model with one to four changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        tags = [x.span() for x in re.finditer(r"<[^>]*>", text)] or [(0, 0)]
        start, end = rng.choice(tags)
        kind = rng.random()
        if kind < 0.6:
            values = [x.span(1) for x in re.finditer(r"=\s*\"([^\"]*)\"", text)] or [(0, 0)]
            start, end = rng.choice(values)
            words = text[start:end].split() or [""]
            words[rng.randrange(len(words))] = rng.choice(NUMBERS + WORDS)
            text = text[:start] + " ".join(words) + text[end:]
        elif kind < 0.7:
            text = text[:start] + text[end:]
        elif kind < 0.85:
            text = text[:end] + rng.choice(ELEMENTS) + text[end:]
        elif kind < 0.93:
            other = rng.choice(tags)
            text = text[:end] + text[slice(*other)] + text[end:]
        else:
            k = rng.randrange(len(text) + 1)
            text = text[:k] + rng.choice("\x00<\"'\u00ff&") + text[k + rng.randrange(20) :]
    return text


def refusal(attempt: Callable[[], object]) -> str:
    """The message of a refusal, or nothing; checks that it is short, fast and a sentence."""
    start, message = time.process_time(), ""
    try:
        attempt()
    except RobotError as error:
        message = str(error)
    assert len(message) <= 300
    assert message.isprintable()
    assert time.process_time() - start < SECONDS
    return message


def test_models(
    rounds: Iterator[random.Random], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ours = (scene_dir() / "quadruped.xml").read_text()
    texts = {"model.xml": ours, "model.urdf": bodies.urdf_text("base")}
    for rng in rounds:
        name = rng.choice(list(texts))
        path = tmp_path / name
        path.write_bytes(changed(texts[name], rng).encode(errors="replace"))

        def attempt(path: Path = path) -> None:
            text, problems = sketch(path.name, path)
            if not problems:
                build(parse_robot_file(text, path), visual=True)

        refusal(attempt)
        assert os.listdir(tmp_path) == [name]
        path.unlink()


def test_robot_files(rounds: Iterator[random.Random], tmp_path: Path) -> None:
    path = Path(bodies.write_robot(tmp_path, imu="[0.1, 0.0, 0.02]", foot_radius="0.022"))
    text = path.read_text() + 'knee = "backward"\n'
    extra = ("strip", "servo_stiffness", "body_height", "board_size", "hip_torque", "source", "x")
    values = (*NUMBERS, "[]", "{}", '"LF_foot"', '["trunk"]', '[{ joint = "LF_hip", at = 1e300 }]')
    values += tuple(f'"{x}"' for x in WORDS if x.isprintable())
    for rng in rounds:
        lines = text.splitlines()
        for _ in range(rng.choice((1, 1, 2, 3))):
            k, kind = rng.randrange(len(lines)), rng.random()
            if kind < 0.5 and "=" in lines[k]:
                lines[k] = f"{lines[k].partition('=')[0]}= {rng.choice(values)}"
            elif kind < 0.8:
                lines.insert(0, f"{rng.choice(extra)} = {rng.choice(values)}")
            else:
                lines[k] = lines[k].replace(rng.choice(["FL", "_hip", '"', "[", "."]), "", 1)
        path.write_text("\n".join(lines))
        refusal(lambda: build(read_robot_file(path)))
