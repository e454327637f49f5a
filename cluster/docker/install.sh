#!/bin/sh
# Makes the environment `install.sh FOLDER` of what lock.txt pins.
set -eu

# Where the base has another Python than the lock is for, uv brings that one, into the environment's own folder.
python=$(sed -n '1s/.* for Python \([0-9.]*\) .*/\1/p' lock.txt)
UV_PYTHON_INSTALL_DIR=$1/python uv venv --allow-existing --python "$python" "$1"
uv pip install --python "$1" --require-hashes --no-deps --requirement lock.txt

# Triton compiles against these headers when a model runs.
if grep -q '^triton==' lock.txt; then
    headers=$("$1/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
    test -f "$headers/Python.h" || { echo "BASE: no $headers/Python.h, want a Python with its headers" >&2; exit 1; }
fi

# This package is a layer of its own, above the packages, and every environment finds it there.
echo /opt/vlagents-ray >"$1/lib/python$python/site-packages/vlagents-ray.pth"
