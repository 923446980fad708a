#!/usr/bin/env bash
# Train a model on a folder of posed photographs:
#   bash examples/train_on_photographs.sh my_scene [steps=1500 ...]
# It reads COLMAP, nerfstudio and seven more layouts: data/README.md.
set -euo pipefail
scene=$1
shift

# Check the cameras, with a figure; exit if they do not fit the images.
python -m asysplat.data.check "$scene"

# Every eighth photograph is held out for the test. Your options come last.
python "$(dirname "$0")/../train.py" name=photographs data=files data.root="$scene" "$@"

# Curves: tensorboard --logdir logs/photographs
