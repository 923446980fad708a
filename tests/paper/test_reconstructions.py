"""The page of reconstructions."""

import json
import os
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import yaml

from paper.reconstructions import make_overview, read_reconstructions, report_reconstructions

PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x04\x4c\0\0\x02\x26"
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
    runs = read_reconstructions(folder)
    return [[cell.text for cell in row] for row in make_overview(folder, runs).rows]


def test_the_page_has_numbers_options_and_files(tmp_path, capsys):
    missing = {"missing/lpips": "not measured, as"}
    write_run(tmp_path / "old", {"held_out/psnr": 24.0} | missing, {"steps": 30}, age=9)
    write_run(tmp_path / "deep" / "new")
    report_reconstructions(tmp_path)
    said = capsys.readouterr().out
    assert said.splitlines()[-1] == f"page: {tmp_path / 'reconstructions.html'}"
    assert "25.000" in said and "desk" in said and "LPIPS: not measured, as." in said
    page = Page(tmp_path / "reconstructions.html")
    for text in ("deep/new", "desk", "25.000", "12.000", "19.000", "1,500", "steps=30"):
        assert text in page.texts
    assert not any("home" in text for text in page.texts)
    files = page.files()
    assert all(file.is_file() for file in files)
    names = {(file.parent.name, file.name) for file in files}
    parts = ("contact.png", "scene.html", "scene.ply", "path.mp4")
    assert names == {(run, part) for run in ("old", "new") for part in parts}
    anchors = {attrs.get("id") for _, attrs in page.elements}
    links = [attrs["href"] for tag, attrs in page.elements if tag == "a"]
    assert {link[1:] for link in links if link.startswith("#")} == {"run-0", "run-1"} <= anchors


def test_runs_stand_by_photographs_the_newest_first(tmp_path):
    write_run(tmp_path / "b", age=3)
    write_run(tmp_path / "c", age=2)
    write_run(tmp_path / "d", options={"path": "/data/chair/"}, age=5)
    write_run(tmp_path / "e", {"held_out/psnr": None}, age=9)
    rows = lines(tmp_path)
    assert [row[:2] for row in rows] == [["d", "chair"], *([name, "desk"] for name in "cbe")]
    assert rows[-1][2] == ""


def test_only_options_that_differ_are_shown(tmp_path):
    write_run(tmp_path / "a", options={"refinement": {"rates": {"means": 0.4, "quats": 1}}}, age=1)
    rates = {"rates": {"means": 0.2, "quats": 1}}
    write_run(tmp_path / "b", options={"refinement": rates, "run": "last", "open": True}, age=2)
    assert [row[-1] for row in lines(tmp_path)] == [
        "refinement.rates.means=0.4",
        "refinement.rates.means=0.2",
    ]


def test_the_script_writes_the_page(run_script, tmp_path):
    write_run(tmp_path / "run")
    result = run_script("report.py", f"runs={tmp_path}", f"output={tmp_path / 'site'}")
    assert result.returncode == 0, result.stderr
    page = tmp_path / "site" / "reconstructions.html"
    assert result.stdout.strip().endswith(f"page: {page}")
    assert all(file.is_file() for file in Page(page).files())
    result = run_script("report.py", f"runs={tmp_path / 'site'}")
    assert result.returncode != 0 and "has no finished reconstructions" in result.stderr
