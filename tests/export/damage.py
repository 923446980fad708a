"""Damaged files: what a reader must refuse in one sentence, or read as valid Gaussians."""

import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from random import Random

from asysplat.errors import InputError
from asysplat.scene import Gaussians

INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1)
HEADER = 128  # bytes in which formats keep their integers
VALUES = (None, True, -1, 0, 1, 255, 2**31, 2**64, 10**400, 0.5, -1e300, 1e39, float("nan"))
VALUES += (float("inf"), "", "meta.json", "../x", "\n. \0", [], {}, [[]], [0] * 300)


def damaged(content: bytes, random: Random) -> bytes:
    """Damage a file as transfers, disks and other programs do."""
    data = bytearray(content)
    size = len(data)
    start, other = sorted(random.randrange(size) for _ in range(2))
    length = min(2 ** random.randrange(12), size - other)
    block = slice(start, start + length)
    match random.randrange(7):
        case 0:
            del data[start:]
        case 1:
            for _ in range(2 ** random.randrange(6)):
                data[random.randrange(size)] ^= 1 << random.randrange(8)
        case 2:
            data[block] = bytes(length)
        case 3:
            data[start:start] = data[block]
        case 4:
            data[block], data[other : other + length] = data[other : other + length], data[block]
        case 5:
            del data[block]
        case 6:
            width = random.choice((1, 2, 4, 8))
            start = random.randrange(max(min(size, HEADER) - width, 1))
            value = random.choice(INTEGERS) % 256**width
            data[start : start + width] = value.to_bytes(width, "little")
    return bytes(data)


def damaged_json(content: bytes, random: Random) -> bytes:
    """Remove, replace or copy a value somewhere in JSON."""
    root = json.loads(content)
    places = [(root, key) for key in root]
    for parent, key in places:  # grows as it goes
        value = parent[key]
        if isinstance(value, dict):
            places += [(value, inner) for inner in value]
        elif isinstance(value, list):
            places += [(value, index) for index in range(min(len(value), 4))]
    parent, key = random.choice(places)
    match random.randrange(3):
        case 0:
            del parent[key]
        case 1:
            parent[key] = random.choice(VALUES)
        case 2:
            parent[key] = (lambda place: place[0][place[1]])(random.choice(places))
    try:
        return json.dumps(root).encode()
    except ValueError:  # a value within itself, or too many digits
        return b"[" * 100_000


def damaged_zip(content: bytes, random: Random) -> bytes:
    """Damage a member of a zip file, and write the file with the right checksum."""
    members = read_zip(content)
    name = random.choice(list(members))
    kinds = (damaged, damaged_json) if name.endswith(".json") else (damaged,)
    members[name] = random.choice(kinds)(members[name], random)
    return write_zip(members)


def read_zip(content: bytes) -> dict[str, bytes]:
    """Read all members of a zip file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_zip(members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """Write a zip file of these members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


def variants(
    content: bytes, count: int, *kinds: Callable[[bytes, Random], bytes]
) -> Iterator[bytes]:
    """Yield `count` damaged files, the same ones each time, by each kind of damage in turn."""
    for seed in range(count):
        random = Random(seed)
        yield kinds[seed % len(kinds)](content, random)


def check_reader(
    read: Callable[[Path], Gaussians], path: Path, contents: Iterable[bytes]
) -> tuple[int, int]:
    """Check that a reader returns valid Gaussians or refuses a file in one sentence.

    Returns how many were read, and how many refused.
    """
    counts = [0, 0]
    for index, content in enumerate(contents):
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path).validate()
            counts[0] += 1
        except InputError as error:
            message = str(error)
            assert message.startswith(str(path)), (index, message)
            assert re.fullmatch(r"[^\n]{20,600}\.", message), (index, message)
            own_words = re.sub(r"'.*'", "", message)  # without what it quotes of the file
            assert not re.search(r"\. [A-Z]", own_words), (index, message)
            counts[1] += 1
        except BaseException as error:
            error.add_note(f"of damaged file {index}")
            raise
    return counts[0], counts[1]
