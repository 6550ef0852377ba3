#!/usr/bin/env bash
# digital_rf 2.6.14: DigitalMetadataReader.read(start, method="ffill") may answer with an entry from AFTER `start`.
#
# Good guess: forward fill gives what was noted last at or before `start`, as its description says.
# Behaviour:  where one metadata file holds several entries, it gives the file's LAST one, though that lies later.
# So a receiver's tuning at a sample must not be asked this way: read entries with their sample index and choose.
# Exits 0 while this holds, 1 when it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check digital_rf==2.6.14 'numpy<2.5' 2>/dev/null
"$folder/venv/bin/python" - "$folder" <<'PY'
import os
import sys

import digital_rf

directory = os.path.join(sys.argv[1], "metadata")
os.makedirs(directory)
rate, start = 1000, 1_700_000_000 * 1000
# one file an hour: all three entries are in it
writer = digital_rf.DigitalMetadataWriter(directory, 3600, 3600, rate, 1, "tuning")
for seconds, frequency in ((0, 100e6), (10, 200e6), (20, 300e6)):
    writer.write(start + seconds * rate, {"center_frequencies": frequency})
reader = digital_rf.DigitalMetadataReader(directory)
asked = start + 12 * rate
found = dict(reader.read(asked, method="ffill"))
((index, entry),) = found.items()
print("digital_rf", digital_rf.__version__)
print(f"asked for what held at 12 s; noted at 0, 10 and 20 s; the answer is of {(int(index) - start) / rate:g} s:", entry)
sys.exit(0 if int(index) > asked else 1)
PY
