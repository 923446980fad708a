"""A scene as one page: what its file holds, and what a browser makes of it."""

import base64
import io
import json
import re
import threading
from contextlib import contextmanager
from dataclasses import replace
from html.parser import HTMLParser
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
from browser import open_browser
from PIL import Image

from asysplat.errors import InputError
from asysplat.export import write_page
from asysplat.export.formats.spz import encode_spz, read_spz, write_spz
from asysplat.rendering import blending_weights, render
from asysplat.scene import Gaussians

HEIGHT, WIDTH = 120, 160
MIN_PSNR, MIN_SAME_PSNR = 30, 45  # to the scene; to the scene as SPZ rounds it
MAX_BYTES = 30  # of the page for each Gaussian, with SH of degree 1 and random numbers
EVIL = "</script><script>throw 1</script><img src=x onerror='throw 2'>&amp;\u2028\"'"


@pytest.fixture
def scene(make_scene):
    return make_scene(50, 3, HEIGHT, WIDTH, dtype=torch.float32)


class Elements(HTMLParser):
    """The elements of a page: their names, attributes and text."""

    def __init__(self, page: str):
        super().__init__()
        self.all = []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.all.append([tag, dict(attributes), ""])

    def handle_data(self, data):
        if self.all:
            self.all[-1][2] += data

    def text(self, name: str) -> str:
        return next(text for tag, a, text in self.all if name in (tag, a.get("id"))).strip()


@pytest.fixture
def read(tmp_path):
    def read(content: bytes | str) -> Gaussians:
        content = base64.b64decode(content) if isinstance(content, str) else content
        (tmp_path / "part.spz").write_bytes(content)
        return read_spz(tmp_path / "part.spz")

    return read


def test_a_page_has_all_that_it_needs(scene, tmp_path, read):
    gaussians, cameras = scene
    write_page(tmp_path / "scene.html", gaussians, cameras, focus=[1.0, 2.0, 3.5])
    text = (tmp_path / "scene.html").read_text(encoding="utf-8")
    elements = Elements(text)
    assert not [a for _, a, _ in elements.all if a.keys() & {"src", "href", "srcset", "action"}]
    links = set(re.findall(r"https?://[^\s)]+", text))
    assert links <= {"https://github.com/nianticlabs/spz"}  # in a comment
    assert not re.search(r"@import|url\(|\bimport\b|XMLHttp|fetch\(\"", text)
    first, rest = (read(text) for _, a, text in elements.all if a.get("class") == "spz")
    assert (first.num_gaussians, rest.num_gaussians) == (5, 45)
    weights = blending_weights(gaussians, cameras)
    is_first = weights >= weights.topk(5).values[-1]
    assert first.means.equal(read(encode_spz(gaussians.keep(is_first))).means)
    assert rest.means.equal(read(encode_spz(gaussians.keep(~is_first))).means)
    settings = json.loads(elements.text("settings"))
    assert settings["image"] == [WIDTH, HEIGHT]
    assert [len(camera) for camera in settings["path"]] == [11] * 3
    assert settings["focus"] == [1, -2, -3.5]  # in SPZ's axes
    policy = next(a["content"] for _, a, _ in elements.all if "http-equiv" in a)
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert elements.text("title") == "scene"


def test_names_and_the_title_are_no_markup(scene, tmp_path):
    path = tmp_path / "scene.html"
    write_page(path, *scene, names=["a.jpg", "b.jpg", "c.jpg"], title="title")
    plain = Elements(path.read_text(encoding="utf-8")).all
    write_page(path, *scene, names=[EVIL] * 3, title=EVIL)
    elements = Elements(path.read_text(encoding="utf-8"))
    assert [tag for tag, _, _ in elements.all] == [tag for tag, _, _ in plain]
    assert elements.text("title") == EVIL
    assert json.loads(elements.text("settings"))["names"] == [EVIL] * 3


def test_a_page_is_small(make_scene, tmp_path):
    sizes = []
    for count in (1000, 6000):
        gaussians, cameras = make_scene(count, dtype=torch.float32)
        gaussians = replace(gaussians, sh=gaussians.sh / 4)  # as large as in scenes of photographs
        write_page(tmp_path / "scene.html", gaussians, cameras)
        sizes.append((tmp_path / "scene.html").stat().st_size)
    assert (sizes[1] - sizes[0]) / 5000 < MAX_BYTES
    assert sizes[0] - 1000 * MAX_BYTES < 40_000  # the viewer


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": "scene.htm"}, r"scene\.htm is not the name of a page"),
        ({"names": ["a.jpg"]}, "1 names and 3 cameras"),
    ],
)
def test_what_makes_no_page_is_refused(scene, tmp_path, changes, message):
    arguments = dict(zip(("gaussians", "cameras"), scene, strict=True)) | changes
    path = tmp_path / arguments.pop("path", "scene.html")
    with pytest.raises(InputError, match=message):
        write_page(path, **arguments)
    assert not path.exists()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture
def tab(browser, scene, tmp_path):
    write_page(tmp_path / "scene.html", *scene, names=["a.jpg", EVIL, "c.jpg"])
    tab = browser.open(tmp_path / "scene.html", 320, 200)
    tab.evaluate("asysplat.ready")
    return tab


def pixels(png: str) -> torch.Tensor:
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    return torch.from_numpy(np.array(image)).permute(2, 0, 1) / 255


def psnr(image: torch.Tensor, target: torch.Tensor) -> float:
    assert image.shape == target.shape
    return -10 * (image - target.clamp(0, 1)).square().mean().log10().item()


@pytest.mark.medium
@pytest.mark.parametrize(
    ("degree", "antialiased"), [(0, True), (1, False), (2, True), (3, False), (3, True)]
)
def test_the_picture_is_that_of_our_renderer(browser, make_scene, tmp_path, degree, antialiased):
    gaussians, cameras = make_scene(400, 3, HEIGHT, WIDTH, degree=degree, dtype=torch.float32)
    # A third smaller than a pixel, where antialiasing matters.
    gaussians = replace(gaussians, scales=gaussians.scales * torch.logspace(-3, 0, 400)[:, None])
    background = (0.2, 0.4, 0.9)
    options = {"background": background, "antialiased": antialiased}
    write_page(tmp_path / "scene.html", gaussians, cameras, **options)
    write_spz(tmp_path / "scene.spz", gaussians)
    tab = browser.open(tmp_path / "scene.html")
    tab.evaluate("asysplat.ready")
    image = pixels(tab.evaluate("asysplat.picture(2)").partition(",")[2])

    def target(gaussians):
        options = {"antialiased": antialiased, "depth": False}
        return render(gaussians, cameras, torch.tensor(background), **options).image[2]

    assert psnr(image, target(gaussians)) > MIN_PSNR
    assert psnr(image, target(read_spz(tmp_path / "scene.spz"))) > MIN_SAME_PSNR


@pytest.mark.medium
def test_what_is_on_the_screen_is_the_first_camera_s_image(browser, scene, tmp_path):
    gaussians, cameras = scene
    first = cameras.select([0])
    write_page(tmp_path / "scene.html", gaussians, first)  # no controls for one camera
    tab = browser.open(tmp_path / "scene.html", WIDTH, HEIGHT)
    tab.evaluate("asysplat.ready")
    target = render(gaussians, first, depth=False).image[0]
    assert psnr(pixels(tab.send("Page.captureScreenshot")["data"]), target) > MIN_PSNR
    # A wider window shows more at both sides.
    tab = browser.open(tmp_path / "scene.html", 2 * WIDTH, HEIGHT)
    tab.evaluate("asysplat.ready")
    wide = pixels(tab.send("Page.captureScreenshot")["data"])
    assert psnr(wide[..., WIDTH // 2 : -WIDTH // 2], target) > MIN_PSNR
    assert wide[..., : WIDTH // 2].any()


@contextmanager
def sent_in_two(page: bytes, end_of_first: int):
    """Serve a page of which the rest is sent later: yield its address, and a function for that."""
    rest = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(page[:end_of_first])
            rest.wait(60)
            self.wfile.write(page[end_of_first:])

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}", rest.set
        server.shutdown()


@pytest.mark.medium
def test_a_tenth_is_drawn_before_the_rest_has_come(browser, make_scene, tmp_path):
    gaussians, cameras = make_scene(4000, 3, HEIGHT, WIDTH, dtype=torch.float32)
    gaussians = replace(gaussians, scales=gaussians.scales / 8)
    write_page(tmp_path / "scene.html", gaussians, cameras)
    tab = browser.open(tmp_path / "scene.html")
    tab.evaluate("asysplat.ready")
    whole = tab.evaluate("asysplat.picture(1)")
    page = (tmp_path / "scene.html").read_bytes()
    middle = page.rindex(b'class="spz"') + 1000
    assert middle < 0.5 * len(page), (middle, len(page))
    with sent_in_two(page, middle) as (address, send_rest):
        tab.send("Page.navigate", url=address)
        tab.wait("document.getElementById('message')?.hidden")
        first = tab.evaluate("asysplat.picture(1)")
        assert first != whole and pixels(first.partition(",")[2]).any()
        assert tab.evaluate("document.readyState") == "loading"
        send_rest()
        tab.evaluate("asysplat.ready")
        assert tab.evaluate("asysplat.picture(1)") == whole


@pytest.mark.medium
def test_nothing_leaves_the_page_and_nothing_is_reported(tab):
    tab.send("Page.captureScreenshot")
    requests = [event["request"]["url"] for event in tab.events("Network.requestWillBeSent")]
    assert {url.partition(":")[0] for url in requests} == {"file", "blob"}
    kinds = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")
    assert tab.events(*kinds) == []
    assert (
        tab.evaluate("fetch('https://127.0.0.1').then(() => 'sent', () => 'refused')") == "refused"
    )
    assert "Content Security Policy" in str(tab.events("Log.entryAdded"))


@pytest.mark.medium
def test_controls_move_along_the_photographs(tab):
    def name():
        return tab.evaluate("document.getElementById('name').textContent")

    assert name() == "a.jpg"
    tab.evaluate("document.getElementById('next').click()")
    assert name() == EVIL
    tab.evaluate("slider = document.getElementById('slider'); slider.value = 1.7; slider.oninput()")
    assert name() == "c.jpg"
    tab.evaluate("document.getElementById('previous').click()")
    assert name() == EVIL
    tab.evaluate("document.getElementById('play').click()")
    tab.wait("document.getElementById('slider').value == 2")
    tab.wait("document.getElementById('play').textContent == '▶'")
    assert name() == "c.jpg"
    # Nothing is drawn while nothing changes.
    tab.evaluate("frames = 0; request = requestAnimationFrame; null")
    tab.evaluate("requestAnimationFrame = (draw) => { frames++; request(draw); }; null")
    tab.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert tab.evaluate("frames") == 0


def camera(tab) -> tuple[np.ndarray, np.ndarray]:
    """Position, and axes right, down, forward."""
    position, axes = tab.evaluate("[asysplat.camera().position, asysplat.camera().axes]")
    return np.array(position), np.array(axes)


def drag(tab, x, y, **more):
    tab.mouse("mousePressed", 160, 90, clickCount=1, **more)
    tab.mouse("mouseMoved", 160 + x, 90 + y, **more)
    tab.mouse("mouseReleased", 160 + x, 90 + y, clickCount=1, **more)


@pytest.mark.medium
def test_pointers_and_keys_move_the_camera(tab):
    left = {"button": "left", "buttons": 1}

    def moved(action):
        """Move, and return how far along the axes before, and the axes after."""
        tab.evaluate("asysplat.show(0)")
        before, axes = camera(tab)
        action()
        after, axes_after = camera(tab)
        return axes @ (after - before), axes @ axes_after.T

    offset, turned = moved(lambda: drag(tab, 30, 0, **left))  # the scene follows the mouse
    assert offset[0] < -0.1 and turned[0, 2] > 0.1
    offset, turned = moved(lambda: drag(tab, 0, 30, **left))  # one sees more from above
    assert offset[1] < -0.1 and turned[1, 2] > 0.1
    for options in ({**left, "modifiers": 8}, {"button": "right", "buttons": 2}):
        offset, turned = moved(lambda options=options: drag(tab, 30, 15, **options))
        assert offset[0] < 0 and offset[1] < 0 and abs(offset[2]) < 1e-6
        np.testing.assert_allclose(turned, np.eye(3), atol=1e-6)
    wheel = {"deltaX": 0, "deltaY": -300}
    offset, _ = moved(lambda: tab.mouse("mouseWheel", 160, 90, **wheel))
    assert offset[2] > 0.1 and abs(offset[:2]).max() < 1e-6

    def press(code):
        tab.evaluate("start = asysplat.camera(); null")
        tab.send("Input.dispatchKeyEvent", type="keyDown", code=code)
        tab.wait("asysplat.camera() !== start")
        tab.send("Input.dispatchKeyEvent", type="keyUp", code=code)

    for code, axis, sign in (("KeyD", 0, 1), ("KeyE", 1, -1), ("ArrowUp", 2, 1)):
        offset, _ = moved(lambda code=code: press(code))
        assert sign * offset[axis] > 0 and abs(np.delete(offset, axis)).max() < 1e-6


@pytest.mark.medium
def test_dragging_orbits_the_focus(browser, scene, tmp_path):
    gaussians, cameras = scene
    focus = cameras.centers[0] + cameras.cam_to_world[0, :3, :3] @ torch.tensor([0.5, 0.2, 3.0])
    write_page(tmp_path / "scene.html", gaussians, cameras, focus=focus.tolist())
    tab = browser.open(tmp_path / "scene.html", 320, 200)
    tab.evaluate("asysplat.ready")
    before, axes = camera(tab)
    drag(tab, 40, 20, button="left", buttons=1)
    after, axes_after = camera(tab)
    assert np.linalg.norm(after - before) > 0.1
    focus = focus.numpy() * [1, -1, -1]
    np.testing.assert_allclose(axes_after @ (focus - after), axes @ (focus - before), atol=1e-4)


@pytest.mark.medium
def test_a_double_click_sets_the_point_to_orbit(browser, make_scene, tmp_path):
    gaussians, cameras = make_scene(1, 1, HEIGHT, WIDTH, dtype=torch.float32)
    gaussians = replace(gaussians, means=torch.tensor([[0.4, 0.2, 2.0]]))
    write_page(tmp_path / "scene.html", gaussians, cameras)
    tab = browser.open(tmp_path / "scene.html", WIDTH, HEIGHT)
    tab.evaluate("asysplat.ready")
    (x, y), *_ = cameras.project(gaussians.means)[0][0].tolist()
    tab.evaluate("void addEventListener('dblclick', () => { window.clicked = true; })")
    for clicks in (1, 2):
        click = {"button": "left", "clickCount": clicks}
        tab.mouse("mousePressed", x, y, **click)
        tab.mouse("mouseReleased", x, y, **click)
    tab.wait("window.clicked")  # a busy browser may handle the wheel first
    before, axes = camera(tab)
    tab.mouse("mouseWheel", x, y, deltaX=0, deltaY=-300)
    offset = axes @ (camera(tab)[0] - before)
    ray = cameras.cam_to_world[0, :3, :3].T @ (gaussians.means[0] - cameras.centers[0])
    np.testing.assert_allclose(offset / offset[2], ray / ray[2], atol=0.02)


@pytest.mark.medium
def test_two_fingers_zoom(tab):
    before, axes = camera(tab)

    def touch(kind, *points):
        points = [{"x": x, "y": 90, "id": i} for i, x in enumerate(points)]
        tab.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    touch("touchStart", 140, 180)
    touch("touchMove", 120, 200)
    touch("touchEnd")
    offset = axes @ (camera(tab)[0] - before)
    assert offset[2] > 0.1


@pytest.mark.medium
def test_the_picture_comes_back_after_a_lost_context(tab):
    picture = tab.evaluate("asysplat.picture(1)")
    tab.evaluate(
        "context = document.getElementById('canvas').getContext('webgl2')"
        ".getExtension('WEBGL_lose_context'); null"
    )
    for verb in ("lost", "restored"):
        tab.evaluate(
            "new Promise((done) => { document.getElementById('canvas')"
            f".addEventListener('webglcontext{verb}', () => setTimeout(done, 0));"
            f"context.{verb.replace('lost', 'lose').removesuffix('d')}Context(); }})"
        )
    assert tab.evaluate("asysplat.picture(1)") == picture


@pytest.mark.medium
@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "has no WebGL 2"),
        ("Worker = class { constructor() { throw Error('no threads'); } }", "no threads"),
    ],
)
def test_a_browser_that_lacks_something_says_what(browser, scene, tmp_path, script, message):
    write_page(tmp_path / "scene.html", *scene)
    tab = browser.open(tmp_path / "scene.html", script=script)
    assert message in tab.evaluate("asysplat.ready.catch(({ message }) => message)")
    assert message in tab.evaluate("document.getElementById('message').textContent")
