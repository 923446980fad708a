"""transforms.json, images/ and depth/."""

from asysplat.data.write import write_transforms


def write(views, folder):
    write_transforms(views, folder)
    return folder
