"""Reconstruction of several scenes by one command: a process and a folder for each, a page of all.

Nothing here imports torch, so that mistakes are named and finished scenes are skipped at once.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from omegaconf import DictConfig

from asysplat.errors import InputError
from asysplat.files import check_exists, make_folder, read_json
from asysplat.overrides import path_option
from asysplat.ranges import Count, check_options
from asysplat.root import ROOT


def reconstruct_scenes(paths: Sequence[str], words: Sequence[str], config: DictConfig) -> int:
    """Reconstruct the scenes that are not finished, `jobs` at a time; return how many failed.

    One that fails is named with its error, and the others go on. Each has a folder of its name in
    `scenes` of paths.logs, with what it printed in output.txt; at the end report.py shows all.

    Args:
        paths: photographs or videos.
        words: the other options of the command, for all.
        config: the configuration of any of them.

    Raises:
        InputError: a path that does not exist, or two of one name; before any work.
    """
    check_options({"jobs": config.jobs}, {"jobs": Count})
    names = [Path(path).stem if Path(path).is_file() else Path(path).name for path in paths]
    for path in paths:
        check_exists(Path(path), "photographs or a video")
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{len(twice)} of the scenes are named {twice[0]}: rename a folder.")
    root = Path(config.paths.logs) / "scenes"
    cores = (os.cpu_count() or 1) // config.jobs
    environment = {"OMP_NUM_THREADS": str(max(1, cores))} | os.environ if config.jobs > 1 else None

    def reconstruct(name: str, path: str) -> str | None:
        """Reconstruct a scene; return its error."""
        folder = root / name
        if (run := find_finished(folder)) is not None:
            print(f"{name}: skipped, finished in {run}", flush=True)
            return None
        print(f"{name}: started", flush=True)
        make_folder(folder, "paths.logs")
        options = [path_option("path", path), *words, path_option("paths.run", str(folder / "run"))]
        with open(folder / "output.txt", "w+", errors="replace") as output:
            command = [sys.executable, str(ROOT / "reconstruct.py"), *options]
            streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            status = subprocess.run(command, env=environment, **streams).returncode
            output.seek(0)
            said = output.read().splitlines() or [f"error: status {status}"]
        run = find_finished(folder)
        error = said[-1] if status != 0 or run is None else None
        print(f"{name}: {error or summarize(run)}", flush=True)
        return error

    with ThreadPoolExecutor(config.jobs) as pool:
        futures = [pool.submit(reconstruct, *scene) for scene in zip(names, paths, strict=True)]
        try:
            errors = [future.result() for future in futures]
        except KeyboardInterrupt:  # those that run have it, too, and keep what they have so far
            pool.shutdown(cancel_futures=True)
            done = (future for future in futures if not future.cancelled())
            errors = [future.result() for future in done]
    if any(map(find_finished, (root / name for name in names))):
        subprocess.run([sys.executable, str(ROOT / "report.py"), path_option("runs", str(root))])
    return sum(error is not None for error in errors)


def find_finished(folder: Path) -> Path | None:
    """Return the finished run of a scene: with metrics, which are written after the scene."""
    return next((file.parent for file in sorted(folder.glob("run*/metrics.json"))), None)


def summarize(run: Path) -> str:
    """Write the PSNR, the number of Gaussians and the seconds of a finished run."""
    results = read_json(run / "metrics.json")
    kind = "held_out" if "held_out/psnr" in results else "inputs"
    title = "held out" if kind == "held_out" else "of the inputs"
    return (
        f"{results[f'{kind}/psnr']:.1f} dB {title}, {results['gaussians']:,} Gaussians, "
        f"{results['seconds']:.0f} s of refinement: {run}"
    )
