#!/usr/bin/env bash
# From a folder of posed photographs to a trained model:
#   bash examples/train_on_photographs.sh my_scene [steps=1500 ...]
# COLMAP's, nerfstudio's and seven more layouts are read as they are: data/README.md.
set -euo pipefail
scene=$1
shift

# Do the cameras fit the images? A verdict and a picture; it ends here if they do not.
python -m asysplat.data.check "$scene"

# Every eighth photograph is kept for the test. Options of yours come last and win.
python "$(dirname "$0")/../train.py" name=photographs data=files data.root="$scene" "$@"

# The same training, looked at: tensorboard --logdir logs/photographs
