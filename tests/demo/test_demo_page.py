"""The page in headless Chromium: it balances as Python's evaluation, falls without a policy."""

import functools
import gzip
import http.server
import json
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.chromium import Browser
from fixtures.javascript import REPO, install, node

from mjx_balance.cli.browser import TYPES, write_data
from mjx_balance.evaluation.rollout import observing, policy_scene, run_suite
from mjx_balance.policy.file import load_policy, shipped_policies

pytestmark = [pytest.mark.slow, pytest.mark.browser]

MOST_BYTES = 6_000_000  #: of all files, compressed
READY = "document.getElementById('state')?.textContent === 'balancing'"
PROBLEM = "document.getElementById('problem')?.textContent"
RESULT = "document.getElementById('result')?.textContent"


class Handler(http.server.SimpleHTTPRequestHandler):
    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        self.extensions_map = self.extensions_map | TYPES
        super().__init__(*arguments, **keywords)

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the page as the sources now make it, with the policies of our robot."""
    folder = tmp_path_factory.mktemp("page")
    install()
    subprocess.run([node(), REPO / "demo/build.js", folder], check=True)
    files = shipped_policies()
    shown = [(files[name], policy_scene(load_policy(files[name]))) for name in ("best", "real")]
    write_data(folder, shown)
    return folder


class Server:
    """Serves a folder; can be switched off."""

    def __init__(self, folder: Path) -> None:
        handler = functools.partial(Handler, directory=str(folder))
        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture(scope="module")
def address(page: Path) -> Iterator[str]:
    server = Server(page)
    yield server.address
    server.stop()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("chromium"))
    browser.look(480, 360)  # WebGL in software
    yield browser
    browser.close()


def test_it_is_small_enough_for_a_phone(page: Path) -> None:
    files = [file for file in page.rglob("*") if file.is_file()]
    size = sum(len(gzip.compress(file.read_bytes(), 9)) for file in files)
    print(f"{size / 1e6:.2f} MB in {len(files)} files")
    assert size <= MOST_BYTES
    assert size > 2_000_000


def test_it_loads_without_a_message_and_balances(browser: Browser, address: str) -> None:
    browser.open(address)
    print(f"balances after {browser.wait(READY):.1f} s")
    browser.wait("parseFloat(document.getElementById('tilt').textContent) > 0")
    assert browser.messages == []
    assert browser.run("document.getElementById('problem').hidden")
    assert browser.run("document.getElementById('policy')") is None


def evaluate_there(browser: Browser, address: str, query: str) -> dict[str, Any]:
    browser.open(f"{address}?{query}")
    browser.wait(f"{RESULT} || document.getElementById('problem')?.hidden === false", 400)
    return json.loads(browser.run(RESULT))


@pytest.mark.parametrize(
    ("policy", "suite"), [("best", "corner"), ("real", "push"), ("real", "shift")]
)
def test_it_balances_as_in_pythons_evaluation(
    browser: Browser, address: str, policy: str, suite: str
) -> None:
    """60 s each of two scenarios, every one within 0.01 deg in the mean."""
    found = evaluate_there(browser, address, f"policy={policy}&run={suite}&scenarios=2")
    own = load_policy(policy)
    rollout = run_suite(policy_scene(own), observing(own), suite, 2, 60.0, 0)
    tilt = found["tilt_deg"]
    expected = rollout.tilt.mean(axis=1)
    print(policy, suite, tilt["by_scenario"], expected)
    assert (found["scenarios"], found["duration_s"], found["falls"]) == (2, 60, 0)
    np.testing.assert_allclose(tilt["by_scenario"], expected, atol=0.01)
    assert tilt["mean"] == pytest.approx(rollout.tilt.mean(), abs=0.01)
    assert tilt["max"] == pytest.approx(rollout.tilt.max(), abs=0.05)
    assert tilt["p95"] == pytest.approx(np.percentile(rollout.tilt, 95), abs=0.02)
    assert browser.messages == []


def test_it_falls_without_a_policy(browser: Browser, address: str) -> None:
    found = evaluate_there(browser, address, "policy=none&run=corner&scenarios=2&duration=20")
    assert found["falls"] == 2
    assert found["tilt_deg"]["max"] == 6
    assert found["tilt_deg"]["mean"] > 3


def test_the_reader_tilts_pushes_and_switches_off(browser: Browser, address: str) -> None:
    """The board goes where keys and disc say; a push shows; off holds; a new start balances."""
    browser.open(f"{address}?suite=")
    browser.wait(READY)
    browser.run("Math.random = () => 0.1")  # all pushes one way; two opposed ones cancel
    press = "dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))"
    browser.run(";".join([press] * 3))
    assert browser.run("document.getElementById('knob').style.top") != "50%"
    browser.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'Home'}))")
    assert browser.run("document.getElementById('knob').style.top") == "50%"
    box = browser.run(
        "(pad => { pad.scrollIntoView(); const { x, y } = pad.getBoundingClientRect();"
        "return { x, y }; })(document.getElementById('pad'))"
    )
    for kind, x in (("mousePressed", 76), ("mouseMoved", 110), ("mouseReleased", 110)):
        browser.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=box["x"] + x,
            y=box["y"] + 76,
            button="left",
            clickCount=1,
        )
    assert float(browser.run("document.getElementById('knob').style.left")[:-1]) > 60
    browser.run("document.getElementById('push').click()")
    browser.wait("parseFloat(document.getElementById('tilt').textContent) > 0.3")
    browser.run("document.getElementById('off').click()")
    browser.wait("document.getElementById('state').textContent.includes('holding: switched off')")
    browser.run("document.getElementById('off').click()")
    browser.wait(READY)
    assert browser.run("document.getElementById('knob').style.left") == "50%"
    browser.run("document.getElementById('push-size').value = 1.5")
    browser.run("document.getElementById('push').click(); document.getElementById('push').click()")
    browser.wait("document.getElementById('state').textContent.includes('holding: the ')")
    assert browser.messages == []


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ("policy=x", "policy is 'x'; this page has best, real, pd-imu, none"),
        ("policy=none&robot=x", "robot is 'x'; this page has quadruped"),
        ("suite=x", "suite is 'x'; this robot has paper, corner, "),
        ("run=paper&scenarios=0", "scenarios is '0'; it must be a number from 1 to 8"),
        ("run=paper&duration=x", "duration is 'x'; it must be a number from 0.2 to 60"),
    ],
)
def test_an_address_that_it_does_not_know_gets_one_sentence(
    browser: Browser, address: str, query: str, sentence: str
) -> None:
    browser.open(f"{address}?{query}")
    browser.wait("document.getElementById('problem')?.hidden === false")
    assert browser.run(PROBLEM).startswith(sentence)


def test_a_file_opened_from_disk_says_what_to_do(browser: Browser, page: Path) -> None:
    browser.open((page / "index.html").as_uri())
    browser.wait("document.getElementById('problem')?.hidden === false")
    assert "serve this folder" in browser.run(PROBLEM)


def test_a_browser_without_webassembly_says_so(address: str, tmp_path: Path) -> None:
    browser = Browser(tmp_path)
    script = "delete globalThis.WebAssembly"
    browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    browser.open(address)
    browser.wait("document.getElementById('problem')?.hidden === false")
    assert browser.run(PROBLEM).startswith("This browser has no WebAssembly")
    browser.close()


def test_it_goes_on_without_a_network(page: Path, tmp_path: Path) -> None:
    """Once loaded and kept, everything is there, also a policy that nobody asked for before."""
    server, browser = Server(page), Browser(tmp_path)
    browser.look(480, 360)
    browser.open(server.address)
    browser.wait("navigator.serviceWorker.controller !== null")
    server.stop()
    browser.open(f"{server.address}?policy=real&suite=sea")
    browser.wait(READY)
    browser.close()


@pytest.mark.parametrize("dark", [False, True], ids=("light", "dark"))
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)], ids=("desk", "phone"))
def test_it_fits_the_screen(
    browser: Browser, address: str, width: int, height: int, dark: bool, tmp_path: Path
) -> None:
    """Nothing is cut off at the side; text has enough contrast (WCAG AA)."""
    browser.look(width, height, dark, phone=width < 500)
    browser.open(address)
    browser.wait(READY)
    browser.picture(tmp_path / "page.png")
    assert browser.run("document.documentElement.scrollWidth") == width
    assert browser.run("document.getElementById('view').clientHeight") > 0.4 * height
    colors = browser.run(
        "(style => ['--panel', '--ink', '--quiet', '--accent', '--second', '--bad']"
        ".map(x => style.getPropertyValue(x)))(getComputedStyle(document.documentElement))"
    )
    paper, *inks = map(luminance, colors)
    for color, ink in zip(colors[1:], inks, strict=True):
        low, high = sorted((paper, ink))
        assert (high + 0.05) / (low + 0.05) >= 4.5, color
    assert (paper < 0.1) == dark
    browser.look(480, 360)


def luminance(color: str) -> float:
    """Relative luminance of #rrggbb, as WCAG defines it."""
    values = [int(color.strip()[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4 for x in values]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))
