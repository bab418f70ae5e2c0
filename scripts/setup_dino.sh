#!/usr/bin/env bash
# Adds what DINO encoders need to .venv: the extra `dino`. Not part of `make setup`, for LeRobot then loads it each time.
set -euo pipefail
cd "$(dirname "$0")/.."
if .venv/bin/python -c "import importlib.util, sys; sys.exit(importlib.util.find_spec('transformers') is None)"; then
  exit 0
fi
uv=$(command -v uv || ls .tools/bin/uv .tools/lib/bin/uv 2>/dev/null | head -1 || true)
if [ -z "$uv" ]; then
  echo "setup_dino: uv is missing. Run make setup first, which installs it." >&2
  exit 1
fi
"$uv" pip install --quiet --python .venv/bin/python --constraint requirements.lock -e '.[dino]'
echo "installed transformers into .venv"
