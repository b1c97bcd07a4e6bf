"""Every page of the built site in a browser: what Lighthouse looks at, without Lighthouse."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.chromium import Browser

SITE = Path(__file__).resolve().parent.parent / "site"
LOOKS = {
    f"{name}, {'dark' if dark else 'light'}": (width, height, dark, name == "phone")
    for name, width, height in (("desktop", 1280, 800), ("phone", 390, 844))
    for dark in (False, True)
}
STRUCTURE = """(() => {
  const wrong = [], all = (chosen) => [...document.querySelectorAll(chosen)];
  const name = (x) => (x.innerText || "").trim() || x.getAttribute("aria-label") || x.title;
  if (!document.documentElement.lang) wrong.push("no language");
  if (!document.title.trim()) wrong.push("no title");
  if (!document.querySelector("meta[name=viewport]")) wrong.push("no viewport");
  for (const x of all("img")) if (!x.alt.trim()) wrong.push(`no alt: ${x.src.slice(-60)}`);
  for (const x of all("img"))
    if (!x.complete || !x.naturalWidth) wrong.push(`no picture: ${x.src.slice(-60)}`);
  for (const x of all("video, svg[role=img]"))
    if (!x.getAttribute("aria-label")) wrong.push(`no label: ${x.outerHTML.slice(0, 60)}`);
  for (const x of all("a[href], button"))
    if (!name(x) && !x.querySelector("img[alt]") && x.checkVisibility())
      wrong.push(`nothing to read: ${x.outerHTML.slice(0, 90)}`);
  let level = 0;
  for (const x of all("h1, h2, h3, h4, h5, h6")) {
    const own = Number(x.tagName[1]);
    if (own > level + 1) wrong.push(`h${own} after h${level}: ${name(x)}`);
    level = own;
  }
  const scripted = document.title.startsWith("Search");  // a script writes its heading
  if (all("h1").length != 1 && !scripted) wrong.push(`${all("h1").length} h1`);
  for (const x of performance.getEntriesByType("resource"))
    if (!/^(file|data):/.test(x.name)) wrong.push(`from elsewhere: ${x.name}`);
  return wrong;
})()"""
LOOK = """(() => {
  const wrong = new Set();
  const over = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  if (over > 0) wrong.add(`${over} px wider than the screen`);
  const canvas = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  const known = new Map();
  const rgba = (text) => {  // of any of CSS's notations
    if (!known.has(text)) {
      canvas.clearRect(0, 0, 1, 1);
      canvas.fillStyle = text;
      canvas.fillRect(0, 0, 1, 1);
      const [r, g, b, a] = canvas.getImageData(0, 0, 1, 1).data;
      known.set(text, [r, g, b, a / 255]);
    }
    return known.get(text);
  };
  const mix = (top, below, a) => [0, 1, 2].map((k) => a * top[k] + (1 - a) * below[k]);
  const grounds = new Map();
  const ground = (x) => {  // colour behind an element's text, and the opacity of the text
    if (!x) return [rgba(getComputedStyle(document.documentElement).colorScheme == "dark"
      ? "black" : "white"), 1];
    if (!grounds.has(x)) {
      const [below, opacity] = ground(x.parentElement), style = getComputedStyle(x);
      const own = rgba(style.backgroundColor), seen = opacity * style.opacity;
      grounds.set(x, [mix(own, below, own[3] * seen), seen]);
    }
    return grounds.get(x);
  };
  const light = (colour) => {
    const [r, g, b] = colour.map((x) => {
      const y = x / 255;
      return y <= 0.04045 ? y / 12.92 : ((y + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const visible = { opacityProperty: true, visibilityProperty: true };
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const x = texts.currentNode.parentElement, text = texts.currentNode.data.trim();
    if (!text || x.closest("svg, script, style, noscript") || !x.checkVisibility(visible)) continue;
    const style = getComputedStyle(x), [below, opacity] = ground(x), own = rgba(style.color);
    const size = parseFloat(style.fontSize), bold = Number(style.fontWeight) >= 700;
    const [a, b] = [light(mix(own, below, own[3] * opacity)), light(below)];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < (size >= 24 || (bold && size >= 18.66) ? 3 : 4.5))
      wrong.add(`contrast ${ratio.toFixed(2)}: ${x.tagName} .${x.className} ${text.slice(0, 20)}`);
  }
  return [...wrong].slice(0, 8);
})()"""
STILL = """document.head.append(Object.assign(document.createElement("style"),
  { textContent: "*, ::before, ::after { transition: none !important; }" }))"""
"""Colours do not fade from light to dark."""


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    started = Browser(tmp_path, "--allow-file-access-from-files")
    yield started
    started.close()


def complaints(browser: Browser, page: Path) -> list[str]:
    """What is wrong with a page, on the screens of `LOOKS`."""
    browser.look(*LOOKS["desktop, light"])
    browser.open(page.as_uri())
    here = f"location.href == {json.dumps(page.as_uri())}"
    browser.wait(f"{here} && document.readyState == 'complete'")
    wrong = list(browser.run(STRUCTURE))
    browser.run(STILL)
    for name, look in LOOKS.items():
        browser.look(*look)
        wrong += [f"{name}: {text}" for text in browser.run(LOOK)]
    return wrong + browser.messages


@pytest.mark.browser
@pytest.mark.slow
def test_every_page_can_be_read(browser: Browser) -> None:
    """On a desktop and a phone, in light and dark."""
    pages = sorted(x for x in SITE.rglob("*.html") if x.relative_to(SITE).parts[0] != "demo")
    if not pages:
        pytest.skip("no site here; `make docs` builds it")
    wrong = {str(x.relative_to(SITE)): complaints(browser, x) for x in pages}
    assert not {page: texts for page, texts in wrong.items() if texts}


BAD = """<!doctype html><style>body {{ margin: 0; background: #777; color: #fff; }}
@media (prefers-color-scheme: dark) {{ body {{ background: #000; }} }}</style>{}"""
GOOD = """<html lang="en"><title>x</title><meta name="viewport" content="width=device-width">
<h1 style="color: #fff; background: #000">x</h1>"""


@pytest.mark.browser
@pytest.mark.slow
def test_what_is_wrong_is_seen(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    for text, words in {
        "": "",
        "<p>grey</p>": "contrast 4.48",
        "<p style='opacity: 0.99; background: #000'>x": "",
        "<p style='background: #000; opacity: 0.4'>x": "contrast",
        "<img src='data:image/gif;base64,R0lGODlhAQABAAAAACw='>": "no alt",
        "<img src='missing.png' alt='x'>": "ERR_FILE_NOT_FOUND",
        "<h3 style='background: #000'>x</h3>": "h3 after h1",
        "<video></video>": "no label: <video>",
        "<a href='#'></a><button style='width: 9px'></button>": "nothing to read: <button",
        "<div style='width: 400px; height: 1px'></div>": "10 px wider than the screen",
        "<script>console.warn('oh')</script>": "oh",
        "<script>nothing()</script>": "nothing is not defined",
    }.items():
        page.write_text(BAD.format(GOOD + text))
        wrong = complaints(browser, page)
        assert any(words in x for x in wrong) if words else not wrong, (text, wrong)
    page.write_text("<p style='background: #fff; color: #000'>x")
    assert {"no language", "no title", "no viewport", "0 h1"} <= set(complaints(browser, page))
