"""Camera poses as files hold them, checked and in one convention."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from asysplat.errors import InputError
from asysplat.scene import ORTHONORMAL_TOLERANCE


def rigid(stored: Any, where: str) -> Float[ndarray, "4 4"]:
    """A matrix of rotation and translation, its rotation made exactly orthonormal.

    Args:
        stored: 4 rows of 4 numbers, or an array.
        where: the file, frame and field, for the message.

    Raises:
        InputError: it is none.
    """
    try:
        matrix = np.array(stored, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise InputError(f"{where} is not 4x4: give four rows of four numbers.")
    if not np.isfinite(matrix).all():
        raise InputError(f"{where} holds NaN or infinity: drop this frame or repair its pose.")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > ORTHONORMAL_TOLERANCE:
        raise InputError(f"{where} has last row {matrix[3].tolist()}: it must be 0 0 0 1.")
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where} is not a rotation (R Rᵀ is {error:.2g} from the identity, the determinant is "
            f"{np.linalg.det(rotation):.3g}): remove scale, shear and mirroring from it."
        )
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right
    matrix[3] = (0, 0, 0, 1)
    return matrix


def opencv_from_opengl(cam_to_world: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """OpenGL's y points up and its z backward."""
    return cam_to_world * (1, -1, -1, 1)


def inverted(pose: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Of a rigid matrix, exactly rigid."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result
