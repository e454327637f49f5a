#!/bin/bash
# The pictures of the report in this folder, made anew: plays picture.yaml, and has Chromium look at the page.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}" "${VLAGENTS_RAY:-vlagents-ray}" eval picture.yaml --out "$scratch/picture"

# PICTURE SCHEME: Blink's number of a colour scheme, 0 for dark and 1 for light.
take() {
  "${CHROMIUM:-chromium}" --headless --no-sandbox --disable-gpu --hide-scrollbars --virtual-time-budget=10000 --user-data-dir="$scratch/profile" \
    --blink-settings=preferredColorScheme="$2" --window-size=1200,5760 --screenshot="$PWD/$1" \
    "file://$scratch/picture/report.html"
}
take report-light.png 1
take report-dark.png 0
# A palette takes a third of the room, and nobody sees it.
"${PYTHON:-python3}" - report-light.png report-dark.png <<'END'
import sys
from PIL import Image
for name in sys.argv[1:]:
    Image.open(name).convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3).save(name, optimize=True)
END
