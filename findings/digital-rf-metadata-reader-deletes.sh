#!/usr/bin/env bash
# digital_rf 2.6.14: reading metadata deletes files.
#
# Good guess: DigitalMetadataReader only reads; a file that it cannot open raises or is passed over.
# Behaviour:  a metadata file that HDF5 cannot open is REMOVED from the recording if it is older than the cadence of
#             its files and may be written. A recording copied half (or on a disk that gives errors for a moment) loses
#             metadata by being looked at.
# So rfpose reads a recording's metadata itself and never through this reader; else give it read-only copies.
# Exits 0 while this holds, 1 when it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check digital_rf==2.6.14 'numpy<2.5' 2>/dev/null
"$folder/venv/bin/python" - "$folder" <<'PY'
import contextlib
import glob
import os
import sys
import time

import digital_rf

directory = os.path.join(sys.argv[1], "metadata")
os.makedirs(directory)
start = 1_700_000_000 * 1000
writer = digital_rf.DigitalMetadataWriter(directory, 3600, 60, 1000, 1, "tuning")
writer.write(start, {"center_frequencies": 100e6})
writer.write(start + 90_000, {"center_frequencies": 200e6})
files = sorted(glob.glob(os.path.join(directory, "*", "tuning@*.h5")))
with open(files[-1], "r+b") as file:  # as a copy that was cut off leaves it
    file.truncate(100)
old = time.time() - 7200
os.utime(files[-1], (old, old))
reader = digital_rf.DigitalMetadataReader(directory)
with contextlib.suppress(Exception):
    reader.read(start, start + 120_000)
left = sorted(glob.glob(os.path.join(directory, "*", "tuning@*.h5")))
print("digital_rf", digital_rf.__version__)
print(f"{len(files)} metadata files before reading, {len(left)} after")
sys.exit(0 if len(left) < len(files) else 1)
PY
