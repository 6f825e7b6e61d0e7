"""A page in headless Chromium: what its console says, pictures that do not load, and overflow."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome")
# The browser's own name of the two colour schemes.
SCHEMES = {"dark": 0, "light": 1}
# A window is no narrower than 500 pixels; a frame is as narrow as it is asked to be.
HOST = """<!DOCTYPE html><html><head><meta charset="utf-8">
<meta name="color-scheme" content="light dark"></head><body>
<iframe id="frame" style="width:{width}px;height:800px;border:0" srcdoc="{page}"></iframe>
<script>
addEventListener("load", () => {{
  const page = document.getElementById("frame").contentDocument;
  for (const one of page.querySelectorAll("details")) one.open = true;
  const images = [...page.images];
  const found = {{
    images: images.length,
    broken: images.filter((one) => !one.complete || !one.naturalWidth).length,
    drawings: page.querySelectorAll("svg").length,
    width: page.defaultView.innerWidth,
    needed: page.documentElement.scrollWidth,
    ground: page.defaultView.getComputedStyle(page.body).backgroundColor,
    ink: page.defaultView.getComputedStyle(page.body).color,
  }};
  document.body.innerHTML = "<pre id='found'></pre>";
  document.getElementById("found").textContent = JSON.stringify(found);
}});
</script></body></html>"""


def browser() -> str | None:
    """Chromium or Chrome, if there is one."""
    return next((path for path in map(shutil.which, NAMES) if path), None)


def look_at(page: str, folder: Path, width: int, scheme: str) -> dict[str, object]:
    """What the browser makes of a page.

    Parameters
    ----------
    page : str
        HTML.
    folder : Path
        Is written to.
    width : int
        Pixels.
    scheme : {"light", "dark"}
        What the reader prefers.

    Returns
    -------
    dict
        `console`, a list of lines; numbers of `images` and of `broken` ones; `width` of the view and
        what is `needed`; the colours `ground` and `ink`.
    """
    file = folder / f"{scheme}_{width}.html"
    file.write_text(HOST.format(width=width, page=escape(page)), encoding="utf-8")
    done = subprocess.run(
        [
            browser(), "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
            "--v=0", f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=10000",
            f"--blink-settings=preferredColorScheme={SCHEMES[scheme]}", "--dump-dom", file.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    (found,) = re.findall(r'<pre id="found">(.*?)</pre>', done.stdout, re.DOTALL)
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    return json.loads(unescape(found)) | {"console": console}
