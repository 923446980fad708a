"""Run a script, in each process of torchrun two seconds later than in the one before it."""

import os
import runpy
import sys
import time

if __name__ == "__main__":
    time.sleep(2 * int(os.environ["RANK"]))
    sys.argv = sys.argv[1:]
    sys.path.insert(0, os.getcwd())
    runpy.run_path(sys.argv[0], run_name="__main__")
