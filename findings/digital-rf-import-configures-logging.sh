#!/usr/bin/env bash
# digital_rf 2.6.14: importing the package calls logging.basicConfig.
#
# Good guess: a library leaves the root logger to the program; its own messages go to its own logger.
# Behaviour:  after `import digital_rf` the root logger has a handler on standard error, so the warnings of EVERY
#             library appear there a second time, and a later logging.basicConfig of the program has no effect.
# So a program that reads Digital RF must put the root logger back after the import.
# Exits 0 while this holds, 1 when it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check digital_rf==2.6.14 'numpy<2.5' 2>/dev/null
"$folder/venv/bin/python" - <<'PY'
import logging
import sys

before = list(logging.getLogger().handlers)
import digital_rf

after = list(logging.getLogger().handlers)
logging.basicConfig(filename="/dev/null", level="DEBUG")
print("digital_rf", digital_rf.__version__)
print(f"handlers of the root logger: {len(before)} before the import, {len(after)} after it")
print("level that the program asked for: DEBUG; it has:", logging.getLevelName(logging.getLogger().level))
sys.exit(0 if not before and after and logging.getLogger().level != logging.DEBUG else 1)
PY
