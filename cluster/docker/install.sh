#!/bin/sh
# One environment of an image: `install.sh server EXTRA`, with an extra of pyproject.toml, into /opt/server, or
# `install.sh family NAME`, with requirements/NAME.txt, into /opt/family.
set -eu
kind=$1
name=$2
into=/opt/$kind
lock=docker/locks/$kind-$name.txt

# A family that wants another Python than the base's names it; uv brings it, into the environment's own folder.
python=$(sed -n 's/^# python: *//p' "requirements/$name.txt" 2>/dev/null || true)
if [ -n "$python" ]; then
    UV_PYTHON_INSTALL_DIR=$into/python uv venv --allow-existing --managed-python --python "$python" "$into"
else
    UV_PYTHON_DOWNLOADS=never uv venv "$into"
fi

# A family's environment has the server's packages, too, because a replica runs in it.
if [ -f "$lock" ]; then
    uv pip install --python "$into" --require-hashes --no-deps --requirement "$lock"
elif [ "$kind" = server ]; then
    uv pip install --python "$into" --override docker/torch.txt --requirement pyproject.toml --extra "$name"
else
    uv pip install --python "$into" --override docker/torch.txt --requirement pyproject.toml --extra serve \
        --requirement "requirements/$name.txt"
fi

# This package is a layer of its own in /opt/vlagents-ray, above the packages, and every environment finds it there.
for packages in "$into"/lib/python3.*/site-packages; do
    echo /opt/vlagents-ray >"$packages/vlagents-ray.pth"
done
