"""Tries the page in Chromium: page.py PROGRAM [--only NAME…] [--figures] [--screenshots FOLDER].

Starts PROGRAM on a free port of this machine. Every test is a function `test_…`; each gets a page of its own, in which requests to other
origins, violations of the policy, errors of scripts and a WebGL context that is not there are failures. `--figures` measures instead: how soon a result
can be used, and what a frame takes."""

import argparse
import base64
import contextlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
from pathlib import Path

from playwright.sync_api import expect, sync_playwright

FLAGS = ["--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--ignore-gpu-blocklist", "--no-sandbox", "--disable-dev-shm-usage"]
LONG = 180_000
# Small textures, so that a debug build is quick; screenshots have those that a model comes with.
SMALL = ["--texture-size", "256"]


class Service:
    """A service on a free port; stopped and started again on the same data and port."""

    def __init__(self, program, data):
        self.program, self.data, self.listen, self.process = program, data, "127.0.0.1:0", None

    def start(self):
        command = [self.program, "serve", "--listen", self.listen, "--data-dir", str(self.data), "--log-level", "error", "--jobs", "1"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline().strip()
        if not line.startswith("listening on http://"):
            sys.exit(f"the service did not start: {line!r}")
        self.base = line.removeprefix("listening on ")
        self.listen = self.base.removeprefix("http://")
        return self

    def stop(self, hard=False):
        if self.process:
            self.process.kill() if hard else self.process.terminate()
            self.process.wait(30)
            self.process = None

    def get(self, path):
        with urllib.request.urlopen(self.base + path, timeout=30) as answer:
            return answer.read()


class Bench:
    """What the tests share."""

    def __init__(self, browser, service, work, axe, screenshots):
        self.browser, self.service, self.work, self.screenshots = browser, service, work, screenshots
        self.axe = axe.read_text()

    @contextlib.contextmanager
    def page(self, url=None, width=1440, height=1000, own=True, **more):
        """A page that may do nothing wrong."""
        context = self.browser.new_context(viewport={"width": width, "height": height}, reduced_motion="reduce", **more)
        page = context.new_page()
        wrong = []
        page.on("pageerror", lambda error: wrong.append(f"error: {error}"))
        page.on("console", lambda m: wrong.append(f"console: {m.text}") if m.type == "error" and "Failed to load resource" not in m.text and "net::ERR" not in m.text else None)
        page.on("request", lambda r: wrong.append(f"request: {r.url}") if own and not r.url.startswith((self.service.base, "blob:" + self.service.base)) else None)
        page.add_init_script("addEventListener('securitypolicyviolation', e => console.error('policy: ' + e.violatedDirective + ' ' + e.blockedURI + ' ' + e.sourceFile))")
        page.goto(url or self.service.base + "/")
        yield page
        context.close()
        if wrong:
            raise AssertionError("\n".join(dict.fromkeys(wrong)))

    def sample(self, name):
        path = self.work / f"{name}.glb"
        if not path.exists():
            subprocess.run([self.service.program, "sample", name, "-o", path, *([] if self.screenshots else SMALL)], check=True, stderr=subprocess.DEVNULL)
        return path

    def accessible(self, page, what):
        """No serious or critical finding of axe."""
        # Injected from outside: the policy of the page does not hold for the test.
        page.context.new_cdp_session(page).send("Runtime.evaluate", {"expression": self.axe + ";0"})
        found = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")["violations"]
        serious = [f"{v['id']}: {v['help']}: {n['html'][:160]} {n.get('failureSummary', '')[:240]}" for v in found if v["impact"] in ("serious", "critical") for n in v["nodes"]]
        assert not serious, f"{what}:\n" + "\n".join(serious)

    def shot(self, page, name, element=None):
        if self.screenshots:
            from PIL import Image
            picture = Image.open(io.BytesIO((element or page).screenshot()))
            picture.save(self.screenshots / f"{name}.webp", quality=80, method=6)


def add_files(page, *paths):
    page.locator("#pick-files").set_input_files([str(p) for p in paths])


def drop(page, files):
    """Drops files of `{name: bytes}`, as a person does."""
    data = page.evaluate_handle("""files => { const t = new DataTransfer(); for (const [name, text] of files) t.items.add(new File([Uint8Array.from(atob(text), c => c.charCodeAt(0))], name)); return t; }""",
                                [[name, base64.b64encode(content).decode()] for name, content in files.items()])
    page.dispatch_event(".drop", "drop", {"dataTransfer": data})


def refine(page, recipe=None, require=None, more=None):
    """Asks for a recipe, with little work unless `more` says otherwise, and starts it."""
    more = {"work_budget": 1_000_000} if more is None else more
    page.wait_for_selector("#recipe")
    if recipe:
        page.select_option("#recipe", recipe)
    if require:
        page.get_by_text("Requirements", exact=True).click()
        page.fill("#require", require)
    if more:
        page.get_by_text("All options as JSON").click()
        page.fill("#more", json.dumps(more))
    page.get_by_role("button", name=re.compile("^Refine")).click()


def ready(page):
    page.wait_for_selector("main[data-ready=true]", timeout=LONG)
    page.wait_for_timeout(250)


def job_of(page):
    page.wait_for_url(re.compile(r"\?job=[0-9a-f]{32}$"), timeout=LONG)
    return page.url.split("job=")[1]


def report_of(bench, job):
    return json.loads(bench.service.get(f"/v1/jobs/{job}/artifacts/report.json"))


def pixels(page, selector):
    """What is on the screen there, as a PNG, once it no longer changes."""
    last = None
    for _ in range(20):
        now = page.locator(selector).screenshot()
        if now == last:
            break
        last = now
        page.wait_for_timeout(200)
    return last


def alike(one, other):
    from PIL import Image, ImageChops
    a, b = (Image.open(io.BytesIO(x)).convert("RGB") for x in (one, other))
    if a.size != b.size:
        return False
    # Without the rounded border, which lies twice under the slider.
    inner = (12, 12, a.width - 12, a.height - 12)
    return ImageChops.difference(a.crop(inner), b.crop(inner)).getbbox() is None


# The result that most tests look at.
shared = {}


def shared_result(bench):
    if "job" not in shared:
        with bench.page() as page:
            drop(page, {"scan.glb": bench.sample("scan").read_bytes()})
            refine(page, "scan", more={} if bench.screenshots else None)
            shared["job"] = job_of(page)
            ready(page)
    return f"{bench.service.base}/?job={shared['job']}"


def test_from_drop_to_download(bench):
    with bench.page(accept_downloads=True) as page:
        bench.accessible(page, "the start")
        drop(page, {"textured.glb": bench.sample("textured").read_bytes()})
        expect(page.locator("ul.files li")).to_have_count(1)
        bench.shot(page, "start")
        refine(page, "pack")
        job = job_of(page)
        ready(page)
        assert "Refined" in page.locator("h1").inner_text()
        with page.expect_download() as caught:
            page.get_by_role("link", name=re.compile("Download everything")).click()
        with zipfile.ZipFile(caught.value.path()) as archive:
            assert {"model.glb", "report.json"} <= set(archive.namelist())
        with page.expect_download() as caught:
            page.get_by_role("link", name=re.compile(r"^model\.glb")).click()
        assert Path(caught.value.path()).read_bytes() == bench.service.get(f"/v1/jobs/{job}/artifacts/model.glb")
        # A reload, and the list of this browser, find it.
        page.reload()
        ready(page)
        page.goto(bench.service.base)
        page.locator(".recent a").first.click()
        ready(page)
        assert job in page.url


def test_figures_are_those_of_the_report(bench):
    with bench.page(shared_result(bench)) as page:
        ready(page)
        report = report_of(bench, shared["job"])
        found = page.eval_on_selector_all("[data-path]", "all => all.map(e => [e.dataset.path, e.dataset.value])")
        assert len(found) >= 12, found
        for path, value in found:
            which, name = path.split(".")
            if name == "psnr_db":
                continue
            assert float(value) == report["model"][which][name], (path, value)
        bench.accessible(page, "a result")
        bench.shot(page, "result")
        # The views count what the report counts.
        page.keyboard.press("Escape")
        for which in ("before", "after"):
            page.locator(f"#sheet-{which}").focus()
            page.keyboard.press("p")
            lit = page.locator(f"#sheet-{which}").get_attribute("data-lit")
            assert lit == f"0 {which} {report['atlases'][0][which]['charts'] - 1}", lit
            page.keyboard.press("Escape")


def test_views_show_the_same_pixels_and_share_their_cameras(bench):
    with bench.page(shared_result(bench), height=1700) as page:
        ready(page)
        page.locator(".viewer").scroll_into_view_if_needed()
        assert page.evaluate("!!document.querySelector('#model-after').getContext('webgl2')"), "no WebGL context"
        tabs = page.get_by_role("group", name="Compare")
        hide = "document.querySelectorAll('.divider, .chip').forEach(e => e.style.visibility = 'hidden')"
        page.evaluate(hide)
        for which, end in (("before", "100"), ("after", "0")):
            seen = {}
            for mode in (which.capitalize(), "Slider"):
                tabs.get_by_role("button", name=mode, exact=True).click()
                page.locator(".slide input").first.evaluate("(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", end)
                page.wait_for_timeout(500)
                seen[mode] = [pixels(page, f".pair:has(#{kind}-before)") for kind in ("sheet", "model")]
            one, other = seen.values()
            for kind, a, b in zip(("2D", "3D"), one, other):
                assert alike(a, b), f"{which}, {kind}: the end of the slider is not the single view"
            assert not alike(one[0], one[1])
        tabs.get_by_role("button", name="Side by side").click()
        page.wait_for_timeout(300)
        page.locator("#model-before").scroll_into_view_if_needed()
        box = page.locator("#model-before").bounding_box()
        first = page.locator("#model-before").get_attribute("data-camera")
        page.mouse.move(box["x"] + 100, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 190, box["y"] + 140, steps=6)
        page.mouse.up()
        page.wait_for_timeout(400)
        cameras = [page.locator(f"#model-{w}").get_attribute("data-camera") for w in ("before", "after")]
        assert cameras[0] == cameras[1] != first, cameras
        bench.shot(page, "views", page.locator(".viewer"))


def test_a_chart_is_lit_in_all_views(bench):
    with bench.page(shared_result(bench), height=1700) as page:
        ready(page)
        page.locator("#model-after").click()
        page.wait_for_timeout(400)
        lit = [page.locator(s).get_attribute("data-lit") for s in ("#sheet-before", "#sheet-after", "#model-before", "#model-after")]
        assert lit[0] and len(set(lit)) == 1, lit
        assert all(int(page.locator(f"#sheet-{w}").get_attribute("data-faces")) > 0 for w in ("before", "after"))
        bench.shot(page, "chart", page.locator(".viewer"))
        page.get_by_label("Surface").select_option("density")
        page.get_by_label("Seam lines").check()
        page.get_by_role("button", name="Let go").click()
        page.get_by_role("group", name="Show in 2D").get_by_role("button", name="Charts").click()
        page.get_by_label("Gutters and gaps").check()
        page.wait_for_timeout(500)
        bench.shot(page, "maps", page.locator(".viewer"))


def test_a_failed_gate(bench):
    with bench.page() as page:
        drop(page, {"textured.glb": bench.sample("textured").read_bytes()})
        refine(page, "pack", require="atlas.packing_efficiency >= 0.99\nmodel.charts <= 3")
        ready(page)
        rows = page.locator("table.failures tbody tr")
        expect(rows).to_have_count(2)
        assert "atlas.packing_efficiency" in rows.nth(0).inner_text() and "misses 2 requirements" in page.locator("h1").inner_text()
        assert page.get_by_role("link", name=re.compile("Download everything")).is_visible()
        bench.accessible(page, "a failed gate")
        bench.shot(page, "gate")


def test_broken_files_are_told(bench):
    with bench.page() as page:
        drop(page, {"broken.glb": b"glTF\x02\x00\x00\x00\xff\xff\x00\x00 no model"})
        refine(page)
        page.wait_for_selector(".note.bad", timeout=LONG)
        assert page.locator(".note.bad").inner_text().strip()
        expect(page.locator("ul.files li")).to_have_count(1)
        # What a glTF names is asked for before anything is sent.
        page.get_by_role("button", name="Remove broken.glb").click()
        gltf = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": 4, "uri": "shape.bin"}], "images": [{"uri": "skin%20a.png"}]}
        drop(page, {"scene.gltf": json.dumps(gltf).encode(), "chair.obj": b"mtllib chair.mtl\nv 0 0 0\n"})
        page.get_by_text("3 files are missing").wait_for()
        assert all(name in page.locator(".note.warn").first.inner_text() for name in ("shape.bin", "skin a.png", "chair.mtl"))
        drop(page, {"chair.mtl": b"newmtl a\nmap_Kd -s 1 1 1 wood.jpg\n", "shape.bin": b"1234", "skin a.png": b"x"})
        page.get_by_text("A file is missing").wait_for()
        assert "wood.jpg" in page.locator(".note.warn").first.inner_text()


def slow(bench):
    return bench.sample("scan_10000")


def test_cancel(bench):
    with bench.page() as page:
        add_files(page, slow(bench))
        refine(page, "scan_tight", more={})
        job_of(page)
        page.wait_for_selector("ol.stages li")
        bench.accessible(page, "progress")
        bench.shot(page, "progress")
        page.get_by_role("button", name="Cancel the job").click()
        expect(page.locator("h1")).to_have_text("The job was cancelled", timeout=LONG)


def test_a_service_that_goes_away_and_comes_back(bench):
    with bench.page() as page:
        add_files(page, slow(bench))
        refine(page, "scan", more={})
        job_of(page)
        page.wait_for_selector("ol.stages li")
        bench.service.stop(hard=True)
        page.get_by_text("The connection to the service is lost", exact=True).wait_for(timeout=LONG)
        bench.service.start()
        expect(page.get_by_text("The connection to the service is lost", exact=True)).to_have_count(0, timeout=LONG)
        # A reload in between finds the job again.
        page.reload()
        page.wait_for_selector("ol.stages li", timeout=LONG)
        page.get_by_role("button", name="Cancel the job").click()
        expect(page.locator("h1")).to_have_text("The job was cancelled", timeout=LONG)
    with bench.page(bench.service.base + "/?job=" + "0" * 32) as page:
        expect(page.locator("h1")).to_have_text("There is no such job")


def test_by_keyboard_alone(bench):
    with bench.page() as page:
        choosers = []
        page.on("filechooser", lambda chooser: choosers.append(chooser))
        page.wait_for_selector("#recipe")

        def tab_to(found, most=60):
            for _ in range(most):
                page.keyboard.press("Tab")
                if page.evaluate(found):
                    return
            raise AssertionError(f"Tab does not reach {found}")

        tab_to("document.activeElement.textContent === 'Pick files'")
        page.keyboard.press("Enter")
        for _ in range(100):
            if choosers:
                break
            page.wait_for_timeout(100)
        choosers[0].set_files(str(bench.sample("textured")))
        page.wait_for_selector("ul.files li")
        tab_to("document.activeElement.textContent === 'Refine'")
        page.keyboard.press("Enter")
        job_of(page)
        ready(page)
        assert page.evaluate("document.activeElement.tagName") == "H1", "the verdict has the focus"
        tab_to("document.activeElement.id === 'sheet-after'", 80)
        page.keyboard.press("n")
        page.wait_for_function("document.getElementById('model-before').dataset.lit")
        tab_to("document.activeElement.id === 'model-after'", 80)
        before = page.locator("#model-after").get_attribute("data-camera")
        page.keyboard.press("ArrowLeft")
        page.wait_for_function("before => document.getElementById('model-after').dataset.camera !== before", arg=before)
        page.wait_for_function("document.getElementById('live').textContent")


def test_every_size_both_schemes_and_no_webgl(bench):
    url = shared_result(bench)
    for width, height, scheme in ((360, 740, "dark"), (3840, 2160, "light"), (1440, 1000, "dark")):
        with bench.page(url, width=width, height=height, color_scheme=scheme) as page:
            ready(page)
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{width} px scroll sideways"
            bench.accessible(page, f"{width} px, {scheme}")
            bench.shot(page, f"result-{width}-{scheme}")
            if width == 360:
                page.locator(".viewer").scroll_into_view_if_needed()
                bench.shot(page, "views-360-dark")
    with bench.page() as page:
        page.add_init_script("HTMLCanvasElement.prototype.getContext = (get => function (kind, ...more) { return kind.startsWith('webgl') ? null : get.call(this, kind, ...more); })(HTMLCanvasElement.prototype.getContext)")
        page.goto(url)
        ready(page)
        assert page.get_by_text("3D needs WebGL 2").first.is_visible()
        page.locator("#sheet-after").focus()
        page.keyboard.press("n")
        assert page.locator("#sheet-before").get_attribute("data-lit")


def test_one_file_without_a_service(bench):
    html = bench.work / "report.html"
    subprocess.run([bench.service.program, "refine", bench.sample("textured"), "-o", bench.work / "out.glb", "--html", html, "--set", "work_budget=1000000", "-q"], check=True)
    with bench.page(html.as_uri(), own=False) as page:
        requests = []
        page.on("request", lambda r: requests.append(r.url))
        page.reload()
        ready(page)
        assert "Refined" in page.locator("h1").inner_text() and requests == [html.as_uri()], requests
        assert page.locator("#model-after").get_attribute("data-camera")
        bench.accessible(page, "the file")


def figures(bench, data):
    """How soon results can be used, and what a frame takes."""
    models = {"scan": bench.sample("scan"), "scan_2000": bench.sample("scan_2000")}
    folder = data and Path(data) / "scans" / "meshroom_esp32cam"
    if folder and folder.is_dir():
        models["esp32cam"] = bench.work / "esp32cam.zip"
        with zipfile.ZipFile(models["esp32cam"], "w") as archive:
            for path in sorted(folder.iterdir()):
                archive.write(path, path.name)
    size = sum(len(bench.service.get(p)) for p in ["/"] + [f"/page/{p.name}" for p in (Path(__file__).parents[2] / "src/http/page").iterdir() if p.name != "index.html"])
    print(f"the page: {size} bytes")
    for name, path in models.items():
        with bench.page() as page:
            add_files(page, path)
            refine(page, "pack", more={})
            job = job_of(page)
            ended = None
            while ended is None:
                told = json.loads(bench.service.get(f"/v1/jobs/{job}"))
                ended = time.time() if told["finished_at"] else None
                time.sleep(0.02)
            page.wait_for_selector("main[data-ready=true]", timeout=LONG)
            waited = time.time() - ended
            preview = next(a for a in told["artifacts"] if a["name"] == "preview.bin")
            header = bench.service.get(preview["href"])[12:]
            told_of = json.JSONDecoder().raw_decode(header[:200_000].decode(errors="replace"))[0]
            frame = page.evaluate("""async () => {
                const canvas = document.querySelector('#model-after'), times = [];
                canvas.focus();
                for (let i = 0; i < 25; i++) {
                    const start = performance.now();
                    canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowLeft' }));
                    await new Promise(requestAnimationFrame);
                    const gl = canvas.getContext('webgl2');
                    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
                    times.push(performance.now() - start);
                }
                return times.sort((a, b) => a - b)[12];
            }""")
            size = page.locator("#model-after").bounding_box()
            print(f"{name}: {told_of['shown']} of {told_of['triangles']} triangles (both sides), preview {preview['bytes']} bytes, usable {waited:.2f} s after the end, a frame of both views {frame:.1f} ms ({size['width']:.0f} x {size['height']:.0f} each), job {sum(t['seconds'] for t in told['timings']):.2f} s", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("program")
    parser.add_argument("--browser", default=shutil.which("chromium"))
    parser.add_argument("--axe", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--screenshots", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--figures", action="store_true")
    parser.add_argument("--data", default=os.environ.get("INTARSIA_DATA"))
    given = parser.parse_args()
    if given.screenshots:
        given.screenshots.mkdir(parents=True, exist_ok=True)
    failed = []
    with tempfile.TemporaryDirectory(dir=given.work) as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=given.browser, args=FLAGS)
        service = Service(str(Path(given.program).resolve()), Path(folder) / "data").start()
        try:
            bench = Bench(browser, service, Path(folder), given.axe, given.screenshots)
            if given.figures:
                return figures(bench, given.data)
            for name, test in [(n, t) for n, t in globals().items() if n.startswith("test_")]:
                if given.only and not any(o in name for o in given.only):
                    continue
                started = time.time()
                try:
                    test(bench)
                    print(f"ok      {name} ({time.time() - started:.1f} s)", flush=True)
                except Exception as error:  # One that fails hides no other.
                    failed.append(name)
                    print(f"FAILED  {name} ({time.time() - started:.1f} s)\n{error}", flush=True)
                    if not service.process:
                        service.start()
        finally:
            service.stop()
            browser.close()
    if failed:
        sys.exit(f"{len(failed)} failed: {', '.join(failed)}")


main()
