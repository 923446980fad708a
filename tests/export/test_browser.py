"""The viewer in a real browser: what a person sees is what was rendered."""

import runpy
import time

import cv2
import numpy as np
import pytest
from browser import find_chromium, open_page

from asysplat.data import ProceduralScene
from asysplat.export.frame import page_camera
from asysplat.export.viewer import MAX_PIXELS, Viewer, draw_layer

pytest.importorskip("viser", minversion="1.1")
HEIGHT, WIDTH = 480, 900
FREE = (slice(190, 400), slice(60, 520))  # pixels without panel, notice and axes


@pytest.fixture(scope="module")
def chromium():
    found = find_chromium()
    if found is None:
        pytest.skip("no Chromium on PATH: apt-get install chromium")
    return found


@pytest.fixture
def viewer(repository):
    views = ProceduralScene(seed=5, height=96, width=128).views([0, 8, 16, 24])
    example = runpy.run_path(str(repository / "examples" / "render_scene.py"))
    with Viewer(views, example["gaussians_from_depths"](views), port=0) as viewer:
        yield viewer


def until(found):
    """Wait for something true, a minute at most, and return it."""
    for _ in range(600):
        if result := found():
            return result
        time.sleep(0.1)
    raise TimeoutError("it never came to that")


def arrive(tab, viewer, client, view, folder):
    """Wait until the page stands in a camera, and shows there what is rendered; keep a picture."""
    place = viewer._cameras.centers[view]
    until(lambda: np.allclose(client.camera.position, place, atol=1e-4))

    def apart():
        camera, _ = page_camera(client.camera, MAX_PIXELS)
        rendered = draw_layer(viewer._scene[0], camera) / 255
        screenshot = tab.screenshot()
        cv2.imwrite(str(folder / f"{view}.png"), (255 * screenshot[..., ::-1]).astype(np.uint8))
        rendered = cv2.resize(rendered, (WIDTH, HEIGHT))  # a slow page has fewer pixels
        assert rendered.std() > 0.05
        return np.abs(screenshot - rendered)[FREE].mean()

    until(lambda: apart() < 0.01)


@pytest.mark.medium
def test_a_person_sees_what_is_rendered_and_flies_by_clicks(chromium, viewer, tmp_path):
    cameras = viewer._cameras
    viewer._show_cameras.value = False
    with open_page(chromium, viewer.url, tmp_path, WIDTH, HEIGHT) as tab:
        (client,) = until(viewer._server.get_clients).values()
        arrive(tab, viewer, client, 0, tmp_path)

        # Click on the third camera, from behind them all.
        viewer._show_cameras.value = True
        center, forward = cameras.centers.mean(0), cameras.cam_to_world[0, :3, 2]
        client.camera.position = (center - 2 * forward).numpy()
        client.camera.look_at = center.numpy()
        camera, _ = page_camera(client.camera, MAX_PIXELS)
        inside = camera.cam_to_world[0].inverse() @ cameras.cam_to_world[2]
        place = camera.intrinsics[0] @ (inside[:3, 3] + 0.02 * inside[:3, 2])

        def clicked():
            tab.click(*(WIDTH / camera.width * place[:2] / place[2]).tolist())
            return np.allclose(client.camera.position, cameras.centers[2], atol=1e-4)

        until(clicked)
        viewer._show_cameras.value = False
        arrive(tab, viewer, client, 2, tmp_path)
        assert tab.errors == []
