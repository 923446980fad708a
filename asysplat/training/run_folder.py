"""Choose the folder of a run and lock it."""

import fcntl
import os
import re
import shutil
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from lightning.fabric.plugins.environments import SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only
from torch.distributed import TCPStore

from asysplat.errors import InputError
from asysplat.files import make_folder, refuse_links
from asysplat.runs.checkpoints import LAST, has_checkpoints, newest_folder
from asysplat.runs.runs import RESULTS

LOCK = ".lock"  # in the folder of each run
HYDRA = ".hydra"  # where Hydra writes the configuration
MAX_NAME = 120  # characters; file systems allow 255 bytes


def run_folder(ckpt_path: str | None, runs: str, new: str) -> str:
    """Choose the folder of a run, for `hydra.run.dir` of conf/train.yaml.

    An interrupted run resumes in its own folder; others get `new`. `runs` has all of one name.
    Processes that a launcher has started, each at its own second, get one folder.
    """
    environ = os.environ
    if environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":  # torchrun
        return _of_first_process(partial(_choose_folder, ckpt_path, runs, new))
    if SLURMEnvironment.detect() and int(environ["SLURM_NTASKS"]) > 1:
        # A job that is queued again keeps its number, and must not write over what it has.
        names = ("SLURM_JOB_ID", "SLURM_STEP_ID", "SLURM_RESTART_COUNT")
        words = ("slurm", *(environ[name] for name in names if name in environ))
        new = str(Path(new).with_name("_".join(words)))
    return _choose_folder(ckpt_path, runs, new)


def _of_first_process(choose: Callable[[], str]) -> str:
    """Return what the process of rank 0 chooses, by the store in which torchrun's agents meet."""
    host, port = os.environ["MASTER_ADDR"], int(os.environ["MASTER_PORT"])
    store = TCPStore(host, port, is_master=False)
    key = f"asysplat/run_folder/{os.environ['TORCHELASTIC_RESTART_COUNT']}"
    if os.environ["RANK"] == "0":
        store.set(key, choose())
    return store.get(key).decode()


def _choose_folder(ckpt_path: str | None, runs: str, new: str) -> str:
    if ckpt_path == "last":
        try:
            folder = newest_folder(Path(runs))
        except InputError:  # raised again by find_checkpoint
            return new
    elif ckpt_path is not None and Path(ckpt_path).name == LAST:
        folder = Path(ckpt_path).parents[1]
    else:
        return new
    # An earlier stage has its folder inside the run's.
    run = folder.parent if (folder.parent / LOCK).exists() else folder
    if not has_checkpoints(folder) or (run / RESULTS).exists():
        return new
    refuse_links(run)
    return str(run)


def job_name(overrides: Sequence[str], params: Mapping[str, str] | None) -> str:
    """Name a job of a sweep by its options that vary, for `hydra.sweep.subdir` of conf/train.yaml.

    `params` are `hydra.sweeper.params`. Options swept on the command line are read from sys.argv,
    which a scheduler's processes lack; then every option is in the name.
    """
    command = dict(word.partition("=")[::2] for word in sys.argv[1:])
    assigned = {**(params or {}), **command}
    swept = {key for key, value in assigned.items() if re.match(r"[^\[{'\"]*[,(]", str(value))}
    options = dict(override.partition("=")[::2] for override in overrides)
    named = {key: options[key] for key in options if key in swept} or options
    words = (f"{key.rpartition('/')[2]}={value.rpartition('/')[2]}" for key, value in named.items())
    return re.sub(r"[^\w=,.+-]", "", ",".join(words))[:MAX_NAME]


@contextmanager
def unused_removed(folder: Path) -> Generator[None]:
    """Remove a run's folder if the body fails before anything but Hydra has written to it."""
    try:
        yield
    except BaseException:
        if {path.name for path in folder.glob("*")} <= {HYDRA, LOCK}:
            shutil.rmtree(folder, ignore_errors=True)
            with suppress(OSError):  # other runs are there
                folder.parent.rmdir()
        raise


@contextmanager
def locked(folder: Path) -> Generator[None]:
    """Lock a run's folder against other processes, but for those that it trains with."""
    # Attribute that Lightning adds to its function.
    if rank_zero_only.rank != 0:  # ty: ignore[missing-attribute]
        yield
        return
    make_folder(folder, "paths.logs")
    refuse_links(folder)
    with open(folder / LOCK, "w") as file:
        try:
            # Not flock: the loaders of a killed run would hold it for seconds.
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise InputError(
                f"{folder} is a run that another process still trains: wait for it, or stop it."
            ) from None
        except OSError:
            pass  # a network disk without locks
        for partial in folder.rglob("checkpoints/.next.*.ckpt"):  # leftovers of killed writes
            partial.unlink()
        yield
