"""The viewer: images for its pages, changes of the scene, pages that come and go."""

import json
import sys
import time
from dataclasses import replace
from itertools import combinations
from threading import Event
from unittest.mock import Mock
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from asysplat import Views, write_gaussians
from asysplat.data.write import describe_cameras
from asysplat.errors import InputError
from asysplat.export.gaussians import Notes
from asysplat.export.viewer import LAYERS, MAX_PIXELS, Viewer, cameras_beside, draw_layer, main
from asysplat.export.viewer_cameras import quaternion

pytest.importorskip("viser", minversion="1.1")
from websockets.exceptions import InvalidStatus
from wire import TOLERANCE, open_page


@pytest.fixture
def scene(make_scene):
    """Gaussians and photographs of them, whose cameras a browser can have."""
    gaussians, cameras = make_scene(count=60, views=4, height=90, width=120, dtype=torch.float32)
    focal = torch.tensor([[110.0, 0, 60], [0, 110, 45], [0, 0, 1]])
    cameras = replace(cameras, intrinsics=focal.repeat(4, 1, 1))
    smooth = torch.linspace(0, 1, 120).expand(4, 3, 90, 120)  # JPEG keeps it
    return gaussians, Views(cameras, smooth.clone())


@pytest.fixture
def viewer(scene):
    gaussians, views = scene
    with Viewer(views, gaussians, port=0) as viewer:
        yield viewer


def inside(viewer, gaussians):
    """Return a scene and the cameras in the frame of the pages."""
    return viewer._frame.to_network(gaussians), viewer._cameras


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "timed out"
        time.sleep(0.01)


def test_mistakes_are_refused(scene, viewer, monkeypatch):
    gaussians, views = scene
    batch = type(gaussians).stack([gaussians, gaussians])
    with pytest.raises(InputError, match=r"views have the batch dimensions \(1,\)"):
        Viewer(views.map(lambda tensor: tensor[None]), port=0)
    with pytest.raises(InputError, match=r"gaussians have the batch dimensions \(2,\)"):
        viewer.show(batch)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"needs viser: pip install 'viser>=1\.1'"):
        Viewer(views)


def test_pages_are_served_until_the_viewer_closes(viewer, scene, monkeypatch):
    """A second viewer leaves a taken port alone."""
    second = Viewer(scene[1], port=int(viewer.url.rpartition(":")[2]))
    assert second.url != viewer.url
    for each in (viewer, second):
        with urlopen(each.url) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
    second.close()
    second.close()
    second.wait()
    with monkeypatch.context() as patch:  # Ctrl-C ends waiting and closes
        patch.setattr(viewer._closed, "wait", Mock(side_effect=KeyboardInterrupt))
        viewer.wait()
    for each in (viewer, second):
        with pytest.raises(URLError):
            urlopen(each.url)


def test_pages_come_and_go_and_show_the_rendering_of_their_cameras(scene, viewer):
    gaussians, views = scene
    shown, cameras = inside(viewer, gaussians)
    with open_page(viewer) as first:
        with open_page(viewer) as second:
            for page, view in ((first, 0), (second, 3), (first, 2)):
                page.stand(cameras, view)
                page.picture_like(draw_layer(shown, cameras.select([view])))
            until(lambda: len(viewer._server.get_clients()) == 2)
        until(lambda: len(viewer._server.get_clients()) == 1)
        viewer.show(gaussians)
        first.picture_like(draw_layer(gaussians, views.cameras.select([2])))
        viewer.close()
        assert not viewer._thread.is_alive()


def test_pages_of_other_sites_are_refused(viewer):
    address = "http://127.0.0.1.example.org"
    with pytest.raises(InvalidStatus, match="403"), open_page(viewer, address):
        pass
    with open_page(viewer, viewer.url) as page:
        page.stand(viewer._cameras, 0)
        until(viewer._server.get_clients)


@pytest.mark.medium
def test_pictures_do_not_pile_up_for_a_page_that_does_not_read(viewer):
    noise = np.random.default_rng(0).integers(0, 256, (800, 800, 3), dtype=np.uint8)
    last, count = np.full((8, 8, 3), 200, np.uint8), 120
    with open_page(viewer) as page:
        page.stand(viewer._cameras, 0)
        until(viewer._server.get_clients)
        (client,) = viewer._server.get_clients().values()
        for image in (*[noise] * count, last):  # 60 MB, more than sockets hold
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=90)
            client.flush()
        sent = 0
        while page.picture().shape != last.shape:
            sent += 1
        assert sent < count / 2


def test_the_panel_changes_the_rendering(scene, viewer):
    gaussians, cameras = inside(viewer, scene[0])
    camera = cameras.select([1])
    settings = [(layer, 1, 0.0, 1.0, False) for layer in LAYERS]
    settings += [("color", 0, 0.5, 0.5, True)]
    expected = [draw_layer(gaussians, camera, *values) for values in settings]
    for one, other in combinations(expected, 2):
        assert np.abs(one.astype(int) - other).mean() > 2 * TOLERANCE
    with open_page(viewer) as page:
        page.stand(cameras, 1)
        for values, image in zip(settings, expected, strict=True):
            for handle, value in zip(viewer._settings, values, strict=True):
                handle.value = value
            page.picture_like(image)


def test_the_newest_scene_wins_and_show_does_not_block(scene, monkeypatch):
    """While a picture takes its time, `show` returns; of what it was given the last is drawn."""
    gaussians, views = scene
    drawn, started, turn = [], Event(), Event()

    def slow(gaussians, *rest, **options):
        drawn.append(gaussians.num_gaussians)
        started.set()
        assert turn.wait(60)
        return draw_layer(gaussians, *rest, **options)

    monkeypatch.setattr("asysplat.export.viewer.draw_layer", slow)
    with Viewer(views, port=0) as viewer, open_page(viewer) as page:
        page.stand(viewer._cameras, 0)
        until(viewer._server.get_clients)
        assert "Waiting" in viewer._text.content
        viewer.show(gaussians)
        assert started.wait(60)
        for count in range(20, 50):
            viewer.show(gaussians.keep(torch.arange(60) < count), f"step {count}")
        assert drawn == [60]
        turn.set()
        until(lambda: "step 49" in viewer._text.content)
        until(lambda: drawn[-1] == 49)
        assert set(drawn) == {60, 49}
        assert "49 Gaussians, 120 x 90 pixels" in viewer._text.content


def test_a_shown_scene_is_copied(scene, viewer):
    gaussians, _ = scene
    shown, cameras = inside(viewer, gaussians.map(torch.clone))
    with open_page(viewer) as page:
        viewer.show(gaussians)
        gaussians.sh.zero_()
        page.stand(cameras, 0)
        page.picture_like(draw_layer(shown, cameras.select([0])))


def test_the_sh_degree_follows_the_scene(scene, viewer):
    gaussians, _ = scene
    assert (viewer._sh_degree.max, viewer._sh_degree.value) == (1, 1)
    for degree in (3, 0, 2):
        viewer.show(replace(gaussians, sh=torch.zeros(60, (degree + 1) ** 2, 3)))
        assert (viewer._sh_degree.max, viewer._sh_degree.value) == (degree, degree)
    viewer._sh_degree.value = 1
    viewer.show(replace(gaussians, sh=torch.zeros(60, 9, 3)))
    assert viewer._sh_degree.value == 1


def test_errors_are_in_the_panel_until_the_next_scene(scene, viewer, monkeypatch):
    gaussians, _ = scene
    shown, cameras = inside(viewer, gaussians)
    with open_page(viewer) as page:
        page.stand(cameras, 0)
        with monkeypatch.context() as patch:
            fail = Mock(side_effect=RuntimeError("broken"))
            patch.setattr("asysplat.export.viewer.draw_layer", fail)
            viewer.show(gaussians)
            until(lambda: viewer._text.content == "**RuntimeError:** broken")
        viewer.show(gaussians, "fixed")
        page.picture_like(draw_layer(shown, cameras.select([0])))
        until(lambda: "fixed" in viewer._text.content)


@pytest.mark.medium
def test_coarse_after_a_change_and_in_full_at_rest(scene, monkeypatch):
    gaussians, views = scene
    pixels = []

    def draw(gaussians, camera, **options):
        pixels.append(camera.height * camera.width)
        return draw_layer(gaussians, camera, **options)

    monkeypatch.setattr("asysplat.export.viewer.draw_layer", draw)
    with Viewer(views, gaussians, port=0) as viewer, open_page(viewer) as page:
        page.stand(viewer._cameras.resized(600, 800), 0)
        until(lambda: pixels and pixels[-1] == 600 * 800)
        time.sleep(0.5)
        assert len(pixels) == 2 and pixels[0] < MAX_PIXELS / 15
        page.stand(viewer._cameras.resized(600, 800), 1)
        until(lambda: len(pixels) > 2)
        assert pixels[2] < 600 * 800
        until(lambda: pixels[-1] == 600 * 800)


def test_a_click_on_a_camera_moves_there(scene, viewer):
    gaussians, cameras = inside(viewer, scene[0])
    with open_page(viewer) as page:
        page.stand(cameras, 0)
        until(viewer._server.get_clients)
        (client,) = viewer._server.get_clients().values()
        for view in (2, 3, 0):
            page.click(cameras, view)
            pose, expected = cameras.cam_to_world[view], quaternion(cameras, view)
            # The orientation is what viser sets last.
            until(
                lambda place=pose[:3, 3], expected=expected: (
                    np.allclose(client.camera.position, place, atol=1e-5)
                    and np.isclose(abs(client.camera.wxyz @ expected), 1, atol=1e-6)
                )
            )
            forward = client.camera.look_at - client.camera.position
            distance = np.linalg.norm(forward)
            np.testing.assert_allclose(forward / distance, pose[:3, 2], atol=1e-5)
            assert 0.5 < distance / ((gaussians.means - pose[:3, 3]) @ pose[:3, 2]).median() < 2


@pytest.fixture
def opened(monkeypatch):
    """The viewers that the command opened, which do not wait."""
    viewers = []
    monkeypatch.setattr(Viewer, "wait", lambda viewer: viewers.append(viewer))
    return viewers


@pytest.fixture
def file(scene, tmp_path):
    """A file of Gaussians, with their cameras beside it, the third first."""
    gaussians, views = scene
    write_gaussians(tmp_path / "scene.ply", gaussians, Notes(background=(1.0, 0.5, 0.0)))
    cameras = views.cameras.select([2, 0, 1, 3])
    content = describe_cameras(cameras, [f"/absent/{view}.png" for view in range(4)])
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path / "scene.ply"


def test_the_command_opens_at_the_first_camera_beside_the_scene_upright(scene, file, opened):
    main(str(file), None)
    (viewer,), (_, views) = opened, scene
    first, pose = viewer._server.initial_camera, views.cameras.cam_to_world[2]
    turn = viewer._frame.world_to_mean.float()
    position = viewer._frame.scale * (turn @ pose[:, 3])[:3]
    np.testing.assert_allclose(first.position, position, atol=1e-5)
    forward = torch.tensor(first.look_at - first.position)
    forward = torch.nn.functional.normalize(forward.float(), dim=0)
    torch.testing.assert_close(forward, (turn @ pose[:, 2])[:3], atol=1e-5, rtol=0)
    assert torch.tensor(first.up).float() @ (turn @ pose[:, 1])[:3] < 0  # y is down
    assert first.fov == pytest.approx(2 * np.arctan(45 / 110))
    assert viewer._cameras.num_views == 4
    assert viewer._options()["background"] == (1.0, 0.5, 0.0)


def test_cameras_of_another_scene_are_a_line(scene, file, capsys):
    gaussians = scene[0]
    assert cameras_beside(file, gaussians).num_views == 4
    assert capsys.readouterr().out == ""
    away = replace(gaussians, means=gaussians.means + 1000)
    assert cameras_beside(file, away) is None
    assert "have 0% of the Gaussians in view" in capsys.readouterr().out
    file.with_name("transforms.json").unlink()
    assert cameras_beside(file, gaussians) is None
    assert capsys.readouterr().out == ""
