#!/bin/sh
# Makes the environment `install.sh FOLDER` of what lock.txt pins.
set -eu

# Where the base has another Python than the lock is for, uv brings that one, into the environment's own folder.
python=$(sed -n '1s/.* for Python \([0-9.]*\) .*/\1/p' lock.txt)
UV_PYTHON_INSTALL_DIR=$1/python uv venv --allow-existing --python "$python" "$1"
uv pip install --python "$1" --require-hashes --no-deps --requirement lock.txt

# This package is a layer of its own, above the packages, and every environment finds it there.
echo /opt/vlagents-ray >"$1/lib/python$python/site-packages/vlagents-ray.pth"
