"""pixelSplat's chunks: test/000000.torch with test/index.json beside it."""

import io
import json

import numpy as np
import torch
from PIL import Image

from layouts import pinholes, poses

HAS_DEPTHS = False
KEY = "5aca87f95a9412c6"


def write(views, folder):
    split = folder / "test"
    split.mkdir(parents=True)
    torch.save([scene(views)], split / "000000.torch")
    (split / "index.json").write_text(json.dumps({KEY: "000000.torch"}))
    return folder


def scene(views, key=KEY):
    """One scene of a chunk."""
    return {
        "key": key,
        "url": "https://www.youtube.com/watch?v=0",
        "timestamps": torch.arange(views.num_views) * 33333,
        "cameras": cameras(views),
        "images": [encoded(image) for image in views.images],
    }


def cameras(views):
    size = np.array([views.cameras.width, views.cameras.height] * 2)
    intrinsics = np.array(pinholes(views)) / size
    world_to_cam = np.linalg.inv(poses(views))[:, :3].reshape(-1, 12)
    columns = (intrinsics, np.zeros((len(intrinsics), 2)), world_to_cam)
    return torch.tensor(np.concatenate(columns, axis=1), dtype=torch.float32)


def encoded(image):
    levels = (image * 255).round().byte().permute(1, 2, 0)
    file = io.BytesIO()
    Image.fromarray(levels.numpy()).save(file, format="png")
    return torch.tensor(np.frombuffer(file.getvalue(), dtype=np.uint8).copy())
