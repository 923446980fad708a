"""The folder of a run: which one it is, and that no other process writes there."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lightning.pytorch.utilities import rank_zero_only

from asysplat.errors import InputError
from asysplat.training.checkpoints import LAST, has_checkpoints, newest_folder
from asysplat.training.runs import RESULTS

LOCK = ".lock"  # in the folder of each run


def run_folder(asked: str | None, runs: str, fresh: str) -> str:
    """Choose the folder of a run, for `hydra.run.dir` of conf/train.yaml.

    A run that was cut off goes on in its own folder. Whatever else starts from a checkpoint, as
    more steps of a run that has its results, leaves that one as it is.

    Args:
        asked: the option `ckpt_path`.
        runs: the folder of all runs of one name.
        fresh: the folder of a new run.
    """
    try:
        last = newest_folder(Path(runs)) / "checkpoints" / LAST if asked == "last" else asked
    except InputError:  # which find_checkpoint tells the user
        return fresh
    if last is None or Path(last).name != LAST:
        return fresh
    folder = Path(last).parents[1]
    run = folder.parent if (folder.parent / LOCK).exists() else folder  # of an earlier stage
    return fresh if not has_checkpoints(folder) or (run / RESULTS).exists() else str(run)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep a run's folder to this process, and those that it trains with, until the end.

    Raises:
        InputError: another run trains there.
    """
    if rank_zero_only.rank != 0:
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / LOCK, "w") as file:
        try:
            # Not flock, which a killed run's loaders would still hold for seconds.
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            raise InputError(
                f"{folder} is a run that another process still trains: wait for it, or stop it."
            ) from None
        except OSError:
            pass  # a network disk that cannot lock
        yield
