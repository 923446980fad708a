"""The page of reconstructions, of folders that may come from strangers."""

import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml

from asysplat.errors import InputError
from paper.reconstructions import read_reconstructions
from paper.runs import make_overview, report_runs

PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x04\x4c\0\0\x02\x26"
HOSTILE = "<img src=x onerror=alert(1)>\"'&amp;"
RESULTS = {"gaussians": 1500, "steps": 60, "seconds": 12.5, "protocol/name": "default"}
RESULTS |= {"held_out/psnr": 25.0, "held_out/ssim": 0.8, "held_out/lpips": None}
RESULTS |= {"inputs/psnr": 26.0, "baseline/mean_color/psnr": 12.0}
RESULTS |= {"baseline/nearest_view/psnr": 19.0, "baseline/nearest_view/ssim": 0.5}
OPTIONS = {"path": "/home/me/desk", "height": 256, "held_out_every": 8, "steps": 60, "seed": 0}


def write_run(folder: Path, results=None, options=None, age=0.0) -> Path:
    """Write a finished run, `age` seconds old, with these results and options in place of ours."""
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(RESULTS | (results or {})))
    paths = {"logs": "/home/me/logs", "run": f"/home/me/logs/{folder.name}"}
    options = OPTIONS | {"paths": paths} | (options or {})
    (folder / "config.yaml").write_text(yaml.safe_dump(options))
    for name in ("start.png", "contact.png"):
        (folder / name).write_bytes(PNG)
    for name in ("scene.ply", "scene.html", "path.mp4"):
        (folder / name).write_bytes(bytes(250_000))
    time = 1.7e9 - age
    os.utime(folder / "metrics.json", (time, time))
    return folder


class Page(HTMLParser):
    """Elements with their attributes, and the texts of a page; elements close in order."""

    VOID = ("meta", "link", "img")

    def __init__(self, path: Path):
        super().__init__()
        self.path, self.open, self.elements, self.texts = path, [], [], []
        self.feed(path.read_text(encoding="utf-8"))
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data.strip())

    def files(self) -> list[Path]:
        """The files that links and pictures name, as a browser finds them."""
        found = [attrs.get("href") or attrs.get("src") for _, attrs in self.elements]
        names = [name for name in found if name and not name.startswith(("#", "data:"))]
        assert not any(":" in name or name.startswith("/") for name in names)
        return [
            Path(os.path.normpath(self.path.parent / unquote(name, errors="surrogateescape")))
            for name in names
        ]


def lines(folder: Path) -> list[list[str]]:
    runs, left_out = read_reconstructions(folder)
    assert left_out == []
    return [[cell.text for cell in row] for row in make_overview(folder, runs).rows]


def test_the_page_has_numbers_options_and_files(tmp_path, capsys):
    write_run(tmp_path / "old", {"held_out/psnr": 24.0}, {"steps": 30}, age=9)
    write_run(tmp_path / "deep" / "new")
    report_runs(tmp_path)
    said = capsys.readouterr().out
    assert said.splitlines()[-1] == f"page: {tmp_path / 'index.html'}"
    assert "25.000" in said and "desk" in said
    page = Page(tmp_path / "index.html")
    for text in ("deep/new", "desk", "25.000", "12.000", "19.000", "0.500", "1,500", "steps=30"):
        assert text in page.texts
    assert not any("home" in text for text in page.texts)
    assert "0.2 MB" in page.texts
    files = page.files()
    assert all(file.is_file() for file in files)
    names = {(file.parent.name, file.name) for file in files}
    parts = ("contact.png", "scene.html", "scene.ply", "path.mp4")
    assert names == {(run, part) for run in ("old", "new") for part in parts}
    images = [attrs for tag, attrs in page.elements if tag == "img"]
    assert len(images) == 2 and all(image["loading"] == "lazy" for image in images)
    anchors = {attrs.get("id") for _, attrs in page.elements}
    links = [attrs["href"] for tag, attrs in page.elements if tag == "a"]
    assert {link[1:] for link in links if link.startswith("#")} == {"run-0", "run-1"} <= anchors


def test_runs_stand_by_photographs_the_newest_first_and_the_best_is_marked(tmp_path):
    write_run(tmp_path / "a", {"held_out/psnr": 30.0}, {"height": 128}, age=4)
    write_run(tmp_path / "b", {"held_out/psnr": 26.0}, age=3)
    write_run(tmp_path / "c", age=2)
    write_run(tmp_path / "d", options={"path": "/data/chair/"}, age=5)
    write_run(tmp_path / "e", {"held_out/psnr": None}, age=9)
    runs, _ = read_reconstructions(tmp_path)
    rows = make_overview(tmp_path, runs).rows
    assert [row[0].text for row in rows] == ["d", "c", "b", "a", "e"]
    assert [row[1].text for row in rows] == ["chair", "desk", "desk", "desk", "desk"]
    best = [row[0].text for row in rows if any(cell.style == "best" for cell in row)]
    assert best == ["b"]  # a is measured at another size


def test_only_options_that_differ_are_shown(tmp_path):
    rates = {"rates": {"means": 0.4, "quats": 1}}
    write_run(tmp_path / "a", options={"refinement": rates, "init": "/x/y/scene.ply"}, age=1)
    rates = {"rates": {"means": 0.2, "quats": 1}}
    new = {"refinement": rates, "init": "points", "new": [1], "run": "last", "open": True}
    write_run(tmp_path / "b", options=new, age=2)
    assert [row[-1] for row in lines(tmp_path)] == [
        "init=scene.ply, refinement.rates.means=0.4",
        "init=points, refinement.rates.means=0.2",
    ]


def test_photographs_of_one_name_are_told_apart(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, options={"path": f"/data/{name}/images"})
    write_run(tmp_path / "c", options={"path": "room"})
    assert [row[1] for row in lines(tmp_path)] == ["a/images", "b/images", "room"]


def test_a_run_without_held_out_photographs_has_its_inputs(tmp_path):
    nothing = {key: None for key in RESULTS if key.startswith(("held_out", "baseline"))}
    write_run(tmp_path / "run", nothing)
    [line] = lines(tmp_path)
    assert line[2:7] == ["-"] * 5
    report_runs(tmp_path)
    assert "26.000" in Page(tmp_path / "index.html").texts


def test_names_and_options_are_text(tmp_path, capsys):
    """Of photographs, runs and options, in the page and on the terminal."""
    runs = tmp_path / "my runs #1?.html"
    name = HOSTILE.replace("/", "")
    write_run(runs / name, options={"path": f"/data/{HOSTILE}", "init": HOSTILE})
    write_run(runs / "javascript:alert(1)", options={"path": "\x1b[31mred\u202e", HOSTILE: 1})
    write_run(runs / os.fsdecode(b"not utf-8 \xff"), options={HOSTILE: 2, 7: "[red]x"})
    report_runs(runs)
    assert (runs / "index.html").is_file()
    report_runs(runs, tmp_path / "pages" / "all.html")
    said = capsys.readouterr().out
    assert "\x1b[31mred" not in said and "\u202e" not in said
    page = Page(tmp_path / "pages" / "all.html")
    tags = {tag for tag, _ in page.elements}
    assert not tags & {"script", "iframe", "object", "base", "form"}
    assert not any(key.startswith("on") for _, attrs in page.elements for key in attrs)
    files = page.files()
    assert len(files) == 3 * 5 and all(file.is_file() for file in files)
    assert HOSTILE in "".join(page.texts)
    text = page.path.read_text()
    assert "<img src=x" not in text and not re.search(r"https?://|@import|url\(", text)
    [policy] = [attrs["content"] for _, attrs in page.elements if "http-equiv" in attrs]
    assert policy.startswith("default-src 'none';") and "script-src" not in policy


DAMAGED = {
    "no metrics": lambda run: (run / "metrics.json").unlink(),
    "no configuration": lambda run: (run / "config.yaml").unlink(),
    "truncated": lambda run: (run / "metrics.json").write_text('{"gaussians": 15'),
    "empty": lambda run: (run / "metrics.json").write_bytes(b""),
    "no object": lambda run: (run / "metrics.json").write_text("[1]"),
    "binary": lambda run: (run / "metrics.json").write_bytes(bytes(range(256))),
    "deep": lambda run: (run / "metrics.json").write_text("[" * 100_000),
    "long": lambda run: (run / "metrics.json").write_bytes(b" " * 2**21),
    "a pipe": lambda run: ((run / "metrics.json").unlink(), os.mkfifo(run / "metrics.json")),
    "binary options": lambda run: (run / "config.yaml").write_bytes(bytes(range(256))),
    "options that are a list": lambda run: (run / "config.yaml").write_text("- 1\n- 2\n"),
    "nested options": lambda run: (run / "config.yaml").write_text("[" * 100_000),
    "no path": lambda run: (run / "config.yaml").write_text("height: 3\n1: 2\nnull: 3\n"),
    "a resolver": lambda run: (run / "config.yaml").write_text("path: ${oc.env:HOME}\n"),
    "a class": lambda run: (run / "config.yaml").write_text("path: x\na: {_target_: os.system}"),
}
NUMBERS = {"NaN": float("nan"), "infinity": float("inf"), "huge": 1e300, "a text": "25"}
NUMBERS |= {"a list": [25], "true": True, "many digits": 10**400}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_run_is_left_out_with_a_sentence(damage, tmp_path, capsys):
    write_run(tmp_path / "good")
    DAMAGED[damage](write_run(tmp_path / "bad"))
    check_left_out(tmp_path, capsys)


@pytest.mark.parametrize("key", ["gaussians", "held_out/psnr"])
@pytest.mark.parametrize("number", NUMBERS)
def test_a_wrong_number_leaves_a_run_out(number, key, tmp_path, capsys):
    write_run(tmp_path / "good")
    write_run(tmp_path / "bad", {key: NUMBERS[number]})
    check_left_out(tmp_path, capsys)


def check_left_out(folder, capsys):
    report_runs(folder)
    [said] = [line for line in capsys.readouterr().out.splitlines() if "left out" in line]
    assert said.startswith("left out: bad") and str(Path.home()) not in said
    assert said.removeprefix("left out: ") in Page(folder / "index.html").texts
    assert [run.folder.name for run in read_reconstructions(folder)[0]] == ["good"]


def test_links_are_not_followed(tmp_path):
    outside = write_run(tmp_path / "outside")
    runs = tmp_path / "runs"
    (write_run(runs / "one") / "scene.ply").unlink()
    (runs / "one" / "scene.ply").symlink_to(outside / "scene.ply")
    (runs / "two").symlink_to(outside)
    (write_run(runs / "three") / "metrics.json").unlink()
    (runs / "three" / "metrics.json").symlink_to(outside / "metrics.json")
    (outside / "start.png").rename(runs / "index.html")
    (runs / "index.html").unlink()
    (runs / "index.html").symlink_to(outside / "page.html")
    report_runs(runs)
    assert not (outside / "page.html").exists()
    page = Page(runs / "index.html")
    assert {(file.parent.name, file.name) for file in page.files()} == {
        ("one", name) for name in ("contact.png", "scene.html", "path.mp4")
    }
    assert "three is unfinished: it has no metrics.json of its own." in page.texts


def test_a_page_of_another_is_kept(tmp_path):
    write_run(tmp_path / "run")
    page = tmp_path / "index.html"
    page.write_text("<h1>my site</h1>")
    with pytest.raises(InputError, match="is another page: move it"):
        report_runs(tmp_path)
    assert page.read_text() == "<h1>my site</h1>"
    page.unlink()
    report_runs(tmp_path)
    before = page.read_text()
    report_runs(tmp_path)
    assert page.read_text() == before


def test_a_folder_without_reconstructions_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="is no folder: name one"):
        report_runs(tmp_path / "none")
    with pytest.raises(InputError, match="has no finished reconstructions: make one with"):
        report_runs(tmp_path)
    (write_run(tmp_path / "bad") / "metrics.json").unlink()
    with pytest.raises(InputError, match=r"but 1 that cannot be shown \(bad is unfinished"):
        report_runs(tmp_path)
    assert not (tmp_path / "index.html").exists()


def test_a_picture_that_is_damaged_is_left_out(tmp_path):
    (write_run(tmp_path / "run") / "contact.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    report_runs(tmp_path)
    page = Page(tmp_path / "index.html")
    assert "img" not in [tag for tag, _ in page.elements] and "No picture." in page.texts


def test_the_script_writes_the_page(run_script, tmp_path):
    write_run(tmp_path / "run")
    result = run_script("report.py", f"runs={tmp_path}", f"output={tmp_path / 'site'}")
    assert result.returncode == 0, result.stderr
    page = tmp_path / "site" / "index.html"
    assert result.stdout.strip().endswith(f"page: {page}")
    assert all(file.is_file() for file in Page(page).files())
    result = run_script("report.py", f"runs={tmp_path / 'site'}")
    assert result.returncode != 0 and "has no finished reconstructions" in result.stderr
