"""The built site in a browser, where Chromium is there: nothing is cut, viewers draw and play, no errors."""

import functools
import json
import os
import queue
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGES = (
    "index.html", "gallery.html", "faq.html", "tutorials/your_own_hand.html", "how_to/real_time.html",
    "tutorials/notebooks/03_closed_loop.html", "explanation/quasi_static_model.html",
    "reference/file_formats.html", "reference/hands.html", "reference/command_line.html",
    "reference/api/generated/torch_ekm.control.html", "benchmarks/objects.html",
)  # fmt: skip
VIEWERS = ("turn", "hand", "plan")
_LONGEST = 900  # [s]: a loaded machine may take ten times as long

# Each page in a frame of this width: what is wider than the frame, and code that is cut.
_PROBE = """<!doctype html><body><script>
const found = {}, wait = ms => new Promise(done => setTimeout(done, ms));
(async () => {
  for (const page of %(pages)s) {
    const frame = document.createElement("iframe");
    frame.style = "border: 0; width: %(width)dpx; height: 900px"; frame.src = "/" + page;
    document.body.append(frame);
    await new Promise(done => frame.onload = done);
    await wait(800);
    const inside = frame.contentDocument, view = frame.contentWindow;
    const cut = [...inside.querySelectorAll("pre")].filter(one => one.scrollWidth > one.clientWidth + 1);
    const texts = cut.map(one => one.textContent.slice(0, 60));
    found[page] = {wide: inside.documentElement.scrollWidth, cut: texts};
    if (view.viewer) {
      const shown = new Set();  // a loaded machine draws a frame in a second
      for (let k = 0; k < 600 && shown.size < 3; k++) { shown.add(view.viewer.frame); await wait(50); }
      const gl = inside.getElementById("gl"), copy = document.createElement("canvas");
      copy.width = gl.width; copy.height = gl.height; view.viewer.redraw();
      const pen = copy.getContext("2d"); pen.drawImage(gl, 0, 0);
      const colours = new Set(new Uint32Array(pen.getImageData(0, 0, gl.width, gl.height).data.buffer));
      found[page].viewer = {failed: view.viewer.failed, frames: shown.size, colours: colours.size};
    }
    frame.remove();
  }
  await fetch("/found", {method: "POST", body: JSON.stringify(found)});
})();
</script></body>"""


class Site(SimpleHTTPRequestHandler):
    """The site, and a page that looks at its pages and says what it has found."""

    probe = ""
    found: queue.Queue[dict[str, Any]] = queue.Queue()

    def do_GET(self) -> None:
        if self.path != "/probe":
            super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(self.probe.encode())

    def do_POST(self) -> None:
        self.found.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Nothing is said."""


@pytest.fixture
def look(tmp_path: Path) -> Iterator[Any]:
    """A function ``(pages, width)``: what the browser finds, and the errors on its console."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    built = os.environ.get("TORCH_EKM_SITE")
    if not built or browser is None:
        pytest.skip("needs the site, which make docs builds, and Chromium")
    with ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Site, directory=str(ROOT / built))
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def there(pages: tuple[str, ...], width: int) -> tuple[dict[str, Any], list[str]]:
            Site.probe = _PROBE % {"pages": json.dumps(pages), "width": width}
            options = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--hide-scrollbars"]
            options += ["--enable-unsafe-swiftshader", "--enable-logging=stderr", "--window-size=1500,1000"]
            options += [f"--user-data-dir={tmp_path}", f"http://127.0.0.1:{server.server_port}/probe"]
            with (tmp_path / "said").open("w") as said:
                running = subprocess.Popen([str(browser), *options], stdout=said, stderr=said)
            try:
                found = Site.found.get(timeout=_LONGEST)
            finally:
                running.terminate()
                running.wait()
            lines = (tmp_path / "said").read_text(errors="replace").splitlines()
            return found, [one for one in lines if "CONSOLE" in one and re.search("rror|ailed", one)]

        yield there
        server.shutdown()


@pytest.mark.parametrize("width", [390, 1400])
def test_no_page_is_cut(look: Any, width: int) -> None:
    found, errors = look(PAGES, width)
    assert set(found) == set(PAGES)
    assert not [(page, one) for page, one in found.items() if one["wide"] > width or one["cut"]]
    assert not errors


def test_viewers_draw_and_play(look: Any) -> None:
    found, errors = look(tuple(f"_static/viewer/{name}.html" for name in VIEWERS), 800)
    for page, one in found.items():
        assert one["viewer"]["failed"] == "", page
        assert one["viewer"]["frames"] == 3, page
        assert one["viewer"]["colours"] > 50, page
    assert not errors
