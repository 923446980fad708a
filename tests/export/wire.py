"""A page without a browser: it speaks viser's protocol, and keeps the pictures it is sent."""

from collections import deque
from contextlib import contextmanager

import cv2
import msgspec
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect

from asysplat.export.viewer_cameras import field_of_view, quaternion

TOLERANCE = 6  # of 255, on average: what JPEG may change


@contextmanager
def open_page(viewer, origin=None):
    """Open a page at the viewer, which came from `origin`."""
    address = viewer.url.replace("http", "ws")
    protocols = [f"viser-v{viser.__version__}"]
    with connect(address, origin=origin, subprotocols=protocols, max_size=None) as socket:
        yield WirePage(socket)


class WirePage:
    def __init__(self, socket):
        self._socket, self._pictures = socket, deque()

    def stand(self, cameras, view: int) -> None:
        """Say that the page's camera is this one."""
        rotation, position = cameras.cam_to_world[view, :3, :3], cameras.centers[view]
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": quaternion(cameras, view).tolist(),
            "position": position.tolist(),
            "fov": field_of_view(cameras, view)[0],
            "near": 0.01,
            "far": 1000.0,
            "image_height": cameras.height,
            "image_width": cameras.width,
            "look_at": (position + rotation[:, 2]).tolist(),
            "up_direction": (-rotation[:, 1]).tolist(),
        }
        self._socket.send(msgspec.msgpack.encode(message))

    def click(self, cameras, view: int) -> None:
        """Click on a camera's frustum, from behind it."""
        forward = cameras.cam_to_world[view, :3, 2]
        message = {
            "type": "SceneNodeClickMessage",
            "name": f"/cameras/{view}",
            "instance_index": None,
            "ray_origin": (cameras.centers[view] - 0.02 * forward).tolist(),
            "ray_direction": forward.tolist(),
            "screen_pos": (0.5, 0.5),
            "modifier": None,
        }
        self._socket.send(msgspec.msgpack.encode(message))

    def picture(self) -> np.ndarray:
        """Wait for the next picture, [H, W, 3]."""
        while not self._pictures:
            data = self._socket.recv(timeout=300)  # kernels may compile
            packed = data[16 : 16 + int.from_bytes(data[8:16], "little")]
            for message in msgspec.msgpack.decode(zstandard.decompress(packed))["messages"]:
                if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                    pixels = np.frombuffer(message["rgb_data"], np.uint8)
                    self._pictures.append(cv2.imdecode(pixels, cv2.IMREAD_COLOR)[..., ::-1])
        return self._pictures.popleft()

    def picture_like(self, expected: np.ndarray) -> None:
        """Wait for a picture that is like the expected one, but for what JPEG takes away.

        Fails after 20 others.
        """
        for _ in range(20):
            found = self.picture()
            if found.shape == expected.shape:
                difference = np.abs(found.astype(int) - expected).mean()
                if difference < TOLERANCE:
                    return
        raise AssertionError(f"the last picture differs by {difference} of 255 on average")
