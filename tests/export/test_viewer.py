"""The viewer: what pages are sent, and what it does when scenes change and pages come and go."""

import sys
import time
from dataclasses import replace
from itertools import combinations
from threading import Event, Thread
from urllib.error import URLError
from urllib.request import urlopen

import numpy as np
import pytest
import torch

from asysplat import Views
from asysplat.errors import InputError
from asysplat.export.frame import quaternion
from asysplat.export.layers import LAYERS, Look, draw
from asysplat.export.viewer import IN_ONE_PLACE, NO_PHOTOGRAPH, Viewer, photograph_at

pytest.importorskip("viser", minversion="1.1")
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
    """What the viewer makes of a scene and its cameras, to draw from."""
    return viewer._frame.gaussians(gaussians), viewer._views.cameras


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "it never came to that"
        time.sleep(0.01)


def test_without_viser_it_says_what_to_install(scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"needs viser: pip install 'viser>=1\.1'"):
        Viewer(scene[1])


def test_only_one_scene_can_be_shown(scene, viewer):
    gaussians, views = scene
    batch = type(gaussians).stack([gaussians, gaussians])
    with pytest.raises(InputError, match=r"views have the batch dimensions \(1,\)"):
        Viewer(views.map(lambda tensor: tensor[None]), port=0)
    with pytest.raises(InputError, match=r"gaussians have the batch dimensions \(2,\)"):
        Viewer(views, batch, port=0)
    with pytest.raises(InputError, match=r"gaussians have the batch dimensions \(2,\)"):
        viewer.show(batch)


def test_the_page_is_served_until_it_is_closed(scene):
    viewer = Viewer(scene[1], port=0)
    with urlopen(viewer.url) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read().lower()
    viewer.close()
    viewer.close()
    viewer.wait()
    with pytest.raises(URLError):
        urlopen(viewer.url)


def test_a_port_that_is_taken_is_left_alone(viewer, scene):
    port = int(viewer.url.rpartition(":")[2])
    with Viewer(scene[1], port=port) as second:
        assert second.url != viewer.url
        for each in (viewer, second):
            with urlopen(each.url) as answer:
                assert answer.status == 200


def test_ctrl_c_ends_waiting_and_closes(viewer, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(viewer._closed, "wait", interrupted)
        viewer.wait()
    with pytest.raises(URLError):
        urlopen(viewer.url)


def test_pages_are_sent_what_render_gives_for_their_cameras(scene, viewer):
    gaussians, views = scene
    shown, cameras = inside(viewer, gaussians)
    with open_page(viewer) as first, open_page(viewer) as second:
        for page, view in ((first, 0), (second, 3), (first, 2)):
            page.stand(cameras, view)
            page.picture_like(draw(shown, cameras.select([view]), Look()))
        viewer.show(gaussians)
        first.picture_like(draw(gaussians, views.cameras.select([2]), Look()))


def test_the_panel_changes_what_is_sent(scene, viewer):
    gaussians, cameras = inside(viewer, scene[0])
    camera = cameras.select([1])
    photograph = photograph_at(viewer._views, camera, IN_ONE_PLACE)
    looks = [*map(Look, LAYERS), Look("color", 0, 0.5, 0.5)]
    expected = [draw(gaussians, camera, look, photograph) for look in looks]
    for one, other in combinations(expected, 2):
        assert np.abs(one.astype(int) - other).mean() > 2 * TOLERANCE
    with open_page(viewer) as page:
        page.stand(cameras, 1)
        for look, picture in zip(looks, expected, strict=True):
            viewer._layer.value, viewer._sh_degree.value = look.layer, min(look.sh_degree, 1)
            viewer._least_opacity.value, viewer._size.value = look.least_opacity, look.size
            page.picture_like(picture)


def test_error_asks_for_a_place_where_a_photograph_was_taken(scene, viewer):
    _, cameras = inside(viewer, scene[0])
    viewer._layer.value = "error"
    poses = cameras.cam_to_world.clone()
    poses[0, 0, 3] += 0.1
    with open_page(viewer) as page:
        page.stand(replace(cameras, cam_to_world=poses), 0)
        until(lambda: NO_PHOTOGRAPH in viewer._text.content)
        page.stand(cameras, 0)
        until(lambda: "Gaussians" in viewer._text.content.partition("\n")[0])
        until(lambda: NO_PHOTOGRAPH not in viewer._text.content)


def test_the_newest_scene_wins_and_nobody_waits_for_a_picture(scene, monkeypatch):
    """While a picture takes its time, `show` returns; of what it was given the last is drawn."""
    gaussians, views = scene
    drawn, started, turn = [], Event(), Event()

    def slow(gaussians, *rest):
        drawn.append(gaussians.num_gaussians)
        started.set()
        assert turn.wait(60)
        return draw(gaussians, *rest)

    monkeypatch.setattr("asysplat.export.viewer.draw", slow)
    with Viewer(views, port=0) as viewer, open_page(viewer) as page:
        page.stand(viewer._views.cameras, 0)
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


def test_a_scene_that_changes_in_place_is_shown_as_it_was(scene, viewer):
    gaussians, _ = scene
    before, cameras = inside(viewer, gaussians)
    gaussians.sh.zero_()
    with open_page(viewer) as page:
        page.stand(cameras, 0)
        page.picture_like(draw(before, cameras.select([0]), Look()))


def test_many_scenes_from_another_thread(scene, viewer):
    gaussians, _ = scene
    _, cameras = inside(viewer, gaussians)

    def refine():
        for step in range(30):
            viewer.show(replace(gaussians, opacities=gaussians.opacities * step / 29), f"{step}/29")

    with open_page(viewer) as page:
        page.stand(cameras, 0)
        page.picture()
        thread = Thread(target=refine)
        thread.start()
        for view in (1, 2, 3, 0):
            page.stand(cameras, view)
        thread.join()
        shown = viewer._frame.gaussians(gaussians)
        page.picture_like(draw(shown, cameras.select([0]), Look()))
        until(lambda: "29/29" in viewer._text.content)


def test_the_degrees_of_sh_follow_the_scene(scene, viewer):
    gaussians, _ = scene
    assert (viewer._sh_degree.max, viewer._sh_degree.value) == (1, 1)
    for degree in (3, 0, 2):
        viewer.show(replace(gaussians, sh=torch.zeros(60, (degree + 1) ** 2, 3)))
        assert (viewer._sh_degree.max, viewer._sh_degree.value) == (degree, degree)
    viewer._sh_degree.value = 1
    viewer.show(replace(gaussians, sh=torch.zeros(60, 9, 3)))
    assert viewer._sh_degree.value == 1


def test_what_goes_wrong_is_told_in_the_panel_and_mended_by_the_next_scene(scene, viewer):
    gaussians, _ = scene
    shown, cameras = inside(viewer, gaussians)
    with open_page(viewer) as page:
        page.stand(cameras, 0)
        viewer.show(gaussians.map(lambda tensor: tensor.to("meta")))
        until(lambda: viewer._text.content.startswith("**"))
        viewer.show(gaussians, "fixed")
        page.picture_like(draw(shown, cameras.select([0]), Look()))
        until(lambda: "fixed" in viewer._text.content)


def test_a_page_that_leaves_is_dropped(scene, viewer):
    _, cameras = inside(viewer, scene[0])
    with open_page(viewer) as first:
        first.stand(cameras, 0)
        until(lambda: viewer._pages)
        (page,) = viewer._pages.values()
        with open_page(viewer) as second:
            second.stand(cameras, 1)
            until(lambda: len(viewer._pages) == 2)
        until(lambda: list(viewer._pages.values()) == [page])
    until(lambda: not viewer._pages)
    page.join()


def test_closing_with_a_page_open(scene):
    gaussians, views = scene
    with Viewer(views, gaussians, port=0) as viewer, open_page(viewer) as page:
        page.stand(viewer._views.cameras, 0)
        page.picture()
        pages = list(viewer._pages.values())
        viewer.close()
        for page in pages:
            page.join()
    assert len(pages) == 1


def test_a_click_on_a_camera_leads_there(scene, viewer):
    gaussians, cameras = inside(viewer, scene[0])
    with open_page(viewer) as page:
        page.stand(cameras, 0)
        until(lambda: viewer._pages)
        (client,) = viewer._server.get_clients().values()
        for view in (2, 3, 0):
            viewer._fly(client, view)
            pose = cameras.cam_to_world[view]
            np.testing.assert_allclose(client.camera.position, pose[:3, 3], atol=1e-5)
            forward = client.camera.look_at - client.camera.position
            distance = np.linalg.norm(forward)
            np.testing.assert_allclose(forward / distance, pose[:3, 2], atol=1e-5)
            assert 0.5 < distance / ((gaussians.means - pose[:3, 3]) @ pose[:3, 2]).median() < 2
            wxyz = torch.tensor(client.camera.wxyz)
            expected = torch.tensor(quaternion(cameras, view))
            assert abs(wxyz @ expected) == pytest.approx(1, abs=1e-6)


def test_without_gaussians_it_waits_for_them(scene):
    gaussians, views = scene
    with Viewer(views, port=0) as viewer, open_page(viewer) as page:
        _, cameras = inside(viewer, gaussians)
        page.stand(cameras, 0)
        until(lambda: viewer._pages)
        assert "Waiting" in viewer._text.content
        viewer.show(gaussians, "here")
        page.picture_like(draw(viewer._frame.gaussians(gaussians), cameras.select([0]), Look()))
