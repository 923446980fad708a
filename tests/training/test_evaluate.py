"""evaluate.py of runs, files, images and refinements: results, resumption, report, refusals."""

import csv
import json
import re
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
import torch
from PIL import Image
from tiny import SIZE, VIEWS
from tiny import STEPS as TRAINING
from tiny_runs import COSTS, TINY_SCENES, finished

from asysplat.data import SceneOptions, open_scene
from asysplat.data.images import load_image
from asysplat.data.procedural import ProceduralScene
from asysplat.data.write import write_transforms
from asysplat.evaluation import scenes
from asysplat.export import read_gaussians, write_gaussians
from asysplat.geometry.motion import transform
from asysplat.rendering import render
from paper.fill import fill_table, finished_runs
from paper.systems import find_systems
from paper.tables import load_paper

pytestmark = pytest.mark.medium

STEPS = "post_optimization_steps=[0,3,10]"
MODEL = ["model=asysplat_4m4s", "metrics=longlrm", *SIZE]  # of Table 2


@pytest.fixture(scope="module")
def whole(module_train) -> Path:
    """The folder of a finished run of the model of Table 2."""
    left_out = ["~callbacks.figures", "~callbacks.curve"]
    return finished(module_train(*MODEL, "model.layers=4m4s", *left_out, COSTS))


@pytest.fixture
def evaluate(tmp_path, run_script):
    """Runs evaluate.py with overrides; new folders go below tmp_path."""
    return lambda *overrides: run_script("evaluate.py", *overrides, f"paths.logs={tmp_path}")


def read_evaluation(result) -> tuple[Path, dict]:
    """The folder that the script prints last, and its evaluation.json."""
    assert result.returncode == 0, result.stderr
    label, folder = result.stdout.strip().splitlines()[-1].split(": ", 1)
    assert label == "evaluation"
    return Path(folder), json.loads((Path(folder) / "evaluation.json").read_text())


@pytest.mark.medium
def test_lpips_is_measured_once_its_weights_are_there(
    whole, evaluate, shared, tmp_path, monkeypatch
):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    options = [f"init_path={whole}/checkpoints/last.ckpt", *MODEL, *VIEWS, *TINY_SCENES]
    options += ["post_optimization_steps=0", "data.test_sets={}"]
    without = evaluate(*options, f"paths.weights={tmp_path}")
    _, results = read_evaluation(without)
    assert "test/procedural/post0/lpips" not in results and "paths.download" in without.stdout
    assert results["missing/lpips"].startswith("not measured, as VGG16 is neither in")
    _, results = read_evaluation(evaluate(*options, f"paths.weights={shared}/weights"))
    assert results["test/procedural/post0/lpips"] > 0 and "missing/lpips" not in results


def qualities(results: dict) -> dict:
    return {k: v for k, v in results.items() if k.split("/")[0] in ("test", "inputs", "baseline")}


@pytest.fixture(scope="module")
def evaluated(whole, run_script) -> dict:
    """The run's evaluation."""
    folder, results = read_evaluation(run_script("evaluate.py", f"run={whole}", STEPS))
    assert folder == whole
    return results


def test_a_run_has_its_evaluation_and_that_of_every_image(whole, evaluated):
    own = json.loads((whole / "metrics.json").read_text())
    for name in ("procedural", "rooms", "outdoors"):
        for metric in ("psnr", "ssim", "absrel"):
            after = evaluated[f"test/{name}/post0/{metric}"]
            assert after == pytest.approx(own[f"test/{name}/{metric}"], abs=1e-4)
        inputs = [evaluated[f"inputs/{name}/post{steps}/psnr"] for steps in (0, 3, 10)]
        assert inputs == sorted(set(inputs))
    shared = own.keys() & evaluated.keys()
    assert {"cost/gaussians", "baseline/rooms/nearest_view/psnr"} <= shared
    for key in shared:
        assert evaluated[key] == (
            own[key] if isinstance(own[key], str) else pytest.approx(own[key], abs=1e-4)
        )
    assert evaluated["cost/post0/seconds"] < evaluated["cost/post10/seconds"]
    assert {"post0", "post10"} == {
        path.stem.partition("-")[2] for path in (whole / "figures").glob("evaluation-*.png")
    }

    with (whole / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    of_set = [row for row in rows if row["set"] == "rooms" and row["method"] == "post3"]
    # 2 scenes of 2 targets and 3 inputs.
    assert Counter(row["images"] for row in of_set) == {"targets": 4, "inputs": 6}
    mean = sum(float(row["psnr"]) for row in of_set if row["images"] == "targets") / 4
    assert mean == pytest.approx(evaluated["test/rooms/post3/psnr"], abs=1e-4)


def fill_state_of_the_art(composed, *measured):
    """Table 2, with what was measured of one stage at the tiny size."""
    tiny = [*SIZE, *VIEWS, *TINY_SCENES, *TRAINING, "stage=stage1", "earlier_stages=[]"]
    table, compose = load_paper()["state_of_the_art"], partial(composed, return_hydra_config=True)
    return fill_table(table, tiny, lambda overrides: compose(*overrides), *measured)


def test_the_report_has_rows_with_post_optimization(whole, evaluated, composed):
    filled = fill_state_of_the_art(composed, finished_runs(whole.parents[1]))
    rows = {r.post_optimization: r for r in filled.rows if r.name.startswith("AsySplat")}
    for steps in (3, 10):
        values = rows[steps].values
        assert values["dl3dv/psnr"] == [evaluated[f"test/procedural/post{steps}/psnr"]]
        assert values["mipnerf360/psnr"] == [evaluated[f"test/outdoors/post{steps}/psnr"]]
        assert values["inference_seconds"] == [evaluated[f"cost/post{steps}/seconds"]]
    assert "evaluate.py" in rows[28].note and not rows[28].values


def test_an_interrupted_evaluation_resumes(whole, evaluated, evaluate, tmp_path, monkeypatch):
    """Of a checkpoint by its path, which has the numbers of its run."""
    weights = f"init_path={whole}/checkpoints/last.ckpt"
    command = [weights, *MODEL, *VIEWS, *TINY_SCENES]
    keep = scenes.save_result

    def interrupted(path, result):
        if path.name == "rooms-0.json":
            raise KeyboardInterrupt
        keep(path, result)

    with monkeypatch.context() as patch:
        patch.setattr(scenes, "save_result", interrupted)
        stopped = evaluate(*command, STEPS)
    assert stopped.returncode != 0 and "the same command resumes" in stopped.stderr
    assert not list(tmp_path.rglob("evaluation.json"))
    kept = {path: path.read_bytes() for path in tmp_path.rglob("procedural-*.json")}
    assert len(kept) == 2
    measured = []
    monkeypatch.setattr(scenes, "save_result", lambda p, r: (measured.append(p.stem), keep(p, r)))
    folder, results = read_evaluation(evaluate(*command, STEPS))
    assert folder.parent == tmp_path / "evaluate" and (folder / "config.yaml").is_file()
    assert measured == ["rooms-0", "rooms-1", "outdoors-0", "outdoors-1"]
    assert {path: path.read_bytes() for path in kept} == kept
    assert qualities(results) == qualities(evaluated)

    # What is finished is read; another set of steps is another evaluation.
    measured.clear()
    again = evaluate(*command, STEPS)
    read_evaluation(again)
    assert measured == [] and re.search(r"measured before, as \S+ has them: 6 scenes", again.stdout)
    stored = min(kept)
    stored.write_text("{")
    assert refusal(evaluate(*command, STEPS)).startswith(f"error: {stored} is")
    alone = "data.test_sets=null"
    read_evaluation(evaluate(*command, "post_optimization_steps=[0,2]", alone))
    assert measured == ["procedural-0", "procedural-1"]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    """A folder with a scene on disk."""
    folder = tmp_path_factory.mktemp("scene")
    scene = ProceduralScene(3, 32, 32, num_images=24)
    write_transforms(scene.views(range(24)), folder)
    return folder


ON_DISK = ["data=files", "data.window=[12,24]", "data.val_scenes=1"]


@pytest.fixture(scope="module")
def written(whole, photographs, tmp_path_factory, run_script) -> tuple[Path, dict]:
    """The folder of what the model predicts of that scene, and the model's numbers."""
    folder = tmp_path_factory.mktemp("written")
    given = [f"init_path={whole}/checkpoints/last.ckpt", f"write_gaussians={folder}/ours"]
    data = [*ON_DISK, f"data.root={photographs}", *VIEWS, "post_optimization_steps=[0,2]"]
    _, results = read_evaluation(
        run_script("evaluate.py", *given, *MODEL, *data, f"paths.logs={folder}")
    )
    return folder / "ours", results


def shown(results: dict) -> dict:
    """The qualities with as many digits as are printed."""
    return {key: f"{value:.3f}" for key, value in qualities(results).items()}


def test_what_a_model_writes_measures_as_the_model(written, photographs, evaluate, tmp_path):
    """Bit for bit as safetensors, and as PLY to the digits that are printed."""
    ours, expected = written
    (file,) = ours.iterdir()
    assert file.name == f"{photographs.name}.safetensors"
    data = [*ON_DISK, f"data.root={photographs}", *VIEWS, "metrics=longlrm"]
    folder, found = read_evaluation(
        evaluate(f"gaussians={ours}", *data, "post_optimization_steps=[0,2]")
    )
    assert {"test/files/post0/psnr", "test/files/post2/ssim"} <= qualities(found).keys()
    assert qualities(found) == qualities(expected)
    assert found["evaluation/system"] == "ours" and found["tested/scenes"] == 1
    assert "cost/post0/seconds" not in found and found["cost/post2/seconds"] > 0
    assert folder.name.startswith("ours-") and (folder / "evaluation.csv").is_file()

    scene = tmp_path / "scene.ply"
    write_gaussians(scene, read_gaussians(file))
    _, found = read_evaluation(
        evaluate(f"gaussians={scene}", *data, "post_optimization_steps=[0,2]", "system=PLY")
    )
    assert shown(found) == shown(expected) and found["evaluation/system"] == "PLY"
    assert qualities(found) == pytest.approx(qualities(expected), abs=1e-4)


def test_another_systems_coordinates(written, photographs, evaluate, tmp_path):
    """With its cameras it is measured as in the data's; without, it is refused."""
    ours, expected = written
    (file,) = ours.iterdir()
    motion = torch.eye(4).double()
    motion[:3, :3] = torch.tensor([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
    motion[:3, 3] = torch.tensor([4000.0, 0, -2000])
    system = tmp_path / "other"
    system.mkdir()
    moved = transform(read_gaussians(file), motion).scale_by(2.5)
    write_gaussians(system / f"{photographs.name}.ply", moved)
    data = [f"gaussians={system}", *ON_DISK, f"data.root={photographs}", *VIEWS]
    data += ["post_optimization_steps=0"]
    said = refusal(evaluate(*data))
    assert "other coordinates than the data: put its cameras beside it" in said
    assert not list(tmp_path.rglob("evaluation"))  # before any scene is measured

    content = json.loads((photographs / "transforms.json").read_text())
    for frame in content["frames"]:
        pose = motion @ torch.tensor(frame["transform_matrix"]).double()
        pose[:3, 3] *= 2.5
        frame["transform_matrix"] = pose.tolist()
    (system / f"{photographs.name}.cameras.json").write_text(json.dumps(content))
    result = evaluate(*data, "metrics=longlrm")
    _, found = read_evaluation(result)
    assert "1 scenes fitted by cameras, residual 0.00% at most" in result.stdout
    assert found["tested/residual"] < 1e-5
    for key in ("test/files/post0/psnr", "inputs/files/post0/psnr"):
        assert found[key] == pytest.approx(expected[key], abs=1e-3)


def test_images_measure_as_the_gaussians_that_they_show(written, photographs, evaluate, tmp_path):
    """With 8 bits a channel, as in a file, and the same background."""
    ours, _ = written
    data = [*ON_DISK, f"data.root={photographs}", *VIEWS, "metrics=pixelsplat"]
    data += ["post_optimization_steps=0", "training.background=[0,0,0]"]
    _, expected = read_evaluation(evaluate(f"gaussians={ours}", *data))
    sequence = open_scene(photographs, SceneOptions(32, 32))
    gaussians = read_gaussians(next(ours.iterdir()), sequence.scene.origin)
    rendered = tmp_path / "pixelSplat" / photographs.name
    rendered.mkdir(parents=True)
    images = render(gaussians, sequence.cameras, torch.zeros(3)).image.clamp(0, 1)
    for index, image in enumerate(images):
        pixels = (image * 255).floor().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(rendered / f"{index:05d}.png")
    folder, found = read_evaluation(evaluate(f"images={rendered.parent}", *data))
    assert found["evaluation/system"] == "pixelSplat" and found["tested/scenes"] == 1
    assert not [key for key in found if key.startswith(("cost", "inputs"))]
    tested = {key: value for key, value in qualities(found).items() if key.startswith("test")}
    assert {"test/files/post0/psnr", "test/files/post0/ssim"} <= tested.keys()
    assert "test/files/post0/absrel" not in tested  # images have no depths
    assert tested == pytest.approx({key: expected[key] for key in tested}, abs=0.005)
    assert (folder / "figures" / "evaluation-post0.png").is_file()


def test_written_images_measure_as_what_they_show(written, photographs, evaluate, tmp_path):
    """As their PNGs exactly, and as the renderings but for their rounding to 8 bits."""
    data = [*ON_DISK, f"data.root={photographs}", *VIEWS, "metrics=longlrm"]
    data += ["post_optimization_steps=0"]
    images = tmp_path / "images"
    given = f"gaussians={written[0]}", f"write_images={images}"
    _, rendered = read_evaluation(evaluate(*given, *data))
    assert f"write_images={images} exists" in refusal(evaluate(*given, *data))
    _, found = read_evaluation(evaluate(f"images={images}", *data))
    key, room = "test/files/post0/psnr", images / photographs.name
    assert found[key] == pytest.approx(rendered[key], abs=0.05)

    names = sorted(path.name for path in room.glob("*.png"))
    pixels = [
        torch.stack([torch.tensor(load_image(place / name)) / 255 for name in names])
        for place in (room, room / "target")
    ]
    assert len(names) == 2 and pixels[0].shape == (2, 32, 32, 3)
    stored = [torch.tensor(load_image(photographs / "images" / name)) / 255 for name in names]
    assert torch.equal(pixels[1], torch.stack(stored))
    mse = (pixels[0] - pixels[1]).square().mean((1, 2, 3))
    assert found[key] == pytest.approx(-10 * mse.log10().mean().item(), abs=1e-5)
    nearest = {load_image(path).tobytes() for path in (room / "nearest_input").iterdir()}
    assert nearest <= {load_image(path).tobytes() for path in (photographs / "images").iterdir()}


REFINED = [*SIZE, *VIEWS, *TINY_SCENES, "metrics=longlrm"]


def test_3dgs_is_fitted_to_each_test_scene(evaluate, composed):
    """It fills its row of Table 2, with its seconds."""
    command = ["refinement=3dgs", "refinement_steps=40", "post_optimization_steps=0", *REFINED]
    folder, found = read_evaluation(evaluate(*command))
    assert found["evaluation/system"] == "3dgs" and found["tested/scenes"] == 2
    psnr = found["test/procedural/post0/psnr"]
    assert psnr > found["baseline/procedural/mean_color/psnr"]
    assert found["inputs/procedural/post0/psnr"] > psnr and found["cost/post0/seconds"] > 0
    filled = fill_state_of_the_art(composed, {}, list(find_systems(folder)))
    row = next(row for row in filled.rows if row.name.startswith("3DGS"))
    assert row.values["dl3dv/psnr"] == [psnr]
    assert row.values["inference_seconds"] == [found["cost/post0/seconds"]]
    assert found["cost/post0/steps"] == 40 and "measured: 40 steps in " in row.note


def test_scaffold_gs_is_drawn_view_by_view(evaluate):
    command = ["refinement=scaffold_gs", "refinement_steps=30", *REFINED]
    assert "add post_optimization_steps=0" in refusal(evaluate(*command))
    _, found = read_evaluation(evaluate(*command, "post_optimization_steps=0", "system=Scaffold"))
    assert found["evaluation/system"] == "Scaffold" and found["cost/gaussians"] > 0
    psnr = found["test/procedural/post0/psnr"]
    assert psnr > found["baseline/procedural/mean_color/psnr"]


def test_files_that_lose_their_scene_are_refused_by_name(evaluate, tmp_path):
    (tmp_path / "pixelSplat").mkdir()
    (tmp_path / "pixelSplat" / "room.ply").touch()
    said = refusal(evaluate(f"gaussians={tmp_path}/pixelSplat", "data=files", "data.root=rooms"))
    assert "of pixelSplat: the PLY files that it writes have scaled positions" in said
    assert "images=FOLDER" in said


def refusal(result) -> str:
    """The one sentence that the script says."""
    assert result.returncode != 0 and "Traceback" not in result.stderr
    (said,) = (line for line in result.stderr.splitlines() if line.startswith("error: "))
    return said


REFUSED = {
    "nothing": ([], "nothing is given to evaluate: give one of"),
    "two at once": (["run=last", "init_path=a.ckpt"], "run and init_path is given"),
    "no runs": (["run=last"], "run=last found no finished run in"),
    "no data": (["gaussians=none.ply"], "is measured on photographs of the same scenes: add data="),
    "a name of nothing": (["init_path=a.ckpt", "system=x"], "system=x names the system that made"),
    "files to write": (
        ["gaussians=a", "data=files", "write_gaussians=b"],
        "writes what a model predicts, of run=..., init_path=... or model=...",
    ),
    "post-optimization of images": (
        ["images=none", "data.test_scenes=1", "post_optimization_steps=3"],
        "post_optimization_steps=[3]: images, and Gaussians that depend on the view",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_mistakes_are_one_clear_sentence(evaluate, case, tmp_path):
    overrides, message = REFUSED[case]
    assert message in refusal(evaluate(*overrides))
    assert not list(tmp_path.rglob("evaluation*.*"))


def test_a_run_is_measured_as_it_was_tested(whole, evaluate):
    said = refusal(evaluate(f"run={whole}", "width=0.5"))
    assert f"width does not go with run={whole}" in said and "last.ckpt" in said
