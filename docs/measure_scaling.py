"""Count the paper's network at every size and measure photographs, for docs/scaling.md.

python docs/measure_scaling.py    writes docs/results/scaling.json; then python docs/scaling.py
"""

import io
import json
import os
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from PIL import Image

from asysplat.benchmark.data.photographs import write_photographs
from asysplat.benchmark.machine import describe_machine
from asysplat.data import ProceduralScene, open_scene
from asysplat.data.disparity.maps import write_map
from asysplat.evaluation.static_cost import static_costs

REPO = Path(__file__).resolve().parents[1]
MEASURED = REPO / "docs" / "results" / "scaling.json"
SIZES = ((256, 256), (512, 512), (544, 960))  # of the paper's stages
VIEWS = (8, 16, 32, 64)  # of 256x256, as in docs/results/growth; 32 of the other sizes
SHARED = ("mydesk", "hololens-000", "fox", "fern")  # in the shared folder's data/
QUALITY = 90  # of a JPEG


def measure() -> dict[str, Any]:
    """Count the network at every size, and measure bytes and seconds of a photograph."""
    return {
        "machine": describe_machine(),
        "network": [count(views, 256, 256) for views in VIEWS]
        + [count(32, height, width) for height, width in SIZES[1:]],
        "photographs": [weigh(name) for name in SHARED],
        "reading": read_seconds(),
        "disparity_bytes": disparity_bytes(),
    }


def count(views: int, height: int, width: int) -> dict[str, Any]:
    """Count what one scene costs the paper's network; see `static_costs`."""
    options = ["scale=paper", "model=asysplat_4m4s"]
    with initialize_config_dir(str(REPO / "conf"), version_base=None), torch.device("meta"):
        net = instantiate(compose("train", options).model)
    return {"views": views, "height": height, "width": width} | static_costs(
        net, views, height, width
    )


def weigh(name: str) -> dict[str, Any]:
    """Measure the bytes of a scene's files, and of its photographs as JPEG of 256x256."""
    shared = Path(os.environ.get("ASYSPLAT_SHARED", REPO.parent / "shared"))
    sequence = open_scene(shared / "data" / name, 256, 256)
    every = range(0, sequence.num_frames, max(1, sequence.num_frames // 20))
    photographs = [sequence.scene.photographs[frame] for frame in every]
    encoded = []
    for image in sequence.views(list(every)).images:
        stream = io.BytesIO()
        pixels = (255 * image.permute(1, 2, 0)).round().byte().numpy()
        Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "JPEG", quality=QUALITY)
        encoded.append(stream.tell())
    lens = photographs[0].lens
    return {
        "scene": name,
        "size": [lens.height, lens.width],
        "format": photographs[0].image.suffix,
        "file_bytes": median(p.image.stat().st_size for p in photographs),
        "jpeg_bytes_256": median(encoded),
    }


def read_seconds() -> list[dict[str, Any]]:
    """Measure the seconds of a processor that a JPEG of 540x960 takes to become a view."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        scene = write_photographs(Path(folder) / "scene", 48, 540, 960)
        for height, width in ((64, 64), *SIZES):
            sequence, seconds = open_scene(scene, height, width), []
            for frame in range(sequence.num_frames):
                start = time.process_time()
                sequence.views([frame])
                seconds.append(time.process_time() - start)
            found.append({"height": height, "width": width, "seconds": median(seconds[8:])})
    return found


def disparity_bytes() -> float:
    """Measure the bytes of a map of 272x484: exact inverse depths of synthetic scenes."""
    sizes = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(4):
            depths = ProceduralScene(seed, 272, 484, 16).views([0, 8]).depths
            for depth in depths:
                write_map(Path(folder) / "map.png", (1 / depth.clamp_min(1e-3)).numpy())
                sizes.append((Path(folder) / "map.png").stat().st_size)
    return median(sizes)


if __name__ == "__main__":
    MEASURED.write_text(json.dumps(measure(), indent=2) + "\n")
