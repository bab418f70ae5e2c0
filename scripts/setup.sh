#!/usr/bin/env bash
# Makes .venv with Python 3.12 and everything pinned in requirements.lock. Needs pip (or uv) and nothing else.
set -euo pipefail
cd "$(dirname "$0")/.."
stamp=.venv/.installed
if [ -f "$stamp" ] && [ "$stamp" -nt requirements.lock ] && [ "$stamp" -nt pyproject.toml ]; then exit 0; fi

if command -v uv >/dev/null 2>&1; then
  uv=uv
else
  echo "uv not found: installing it into .tools"
  if ! python3 -m venv .tools >/dev/null 2>&1 || ! .tools/bin/python -m pip --version >/dev/null 2>&1; then
    rm -rf .tools
    if ! python3 -m pip install --quiet --target .tools/lib uv; then
      echo "setup: cannot install uv. Install pip first (Debian: apt-get install python3-pip python3-venv)," >&2
      echo "       or uv itself (macOS: brew install uv; else https://docs.astral.sh/uv), then run make setup again." >&2
      exit 1
    fi
    uv=.tools/lib/bin/uv
  else
    .tools/bin/python -m pip install --quiet uv
    uv=.tools/bin/uv
  fi
fi

if ! "$uv" venv --quiet --clear --python 3.12 .venv; then
  echo "setup: no Python 3.12, which LeRobot 0.6 needs, and uv could not download one." >&2
  echo "       Install it (Debian 13 or newer: apt-get install python3.12 python3.12-venv; else pyenv install 3.12)," >&2
  echo "       then run make setup again." >&2
  exit 1
fi
# Bytecode now, as pip makes it: else the first command of each kind takes tens of seconds, and seems to hang.
if ! "$uv" pip install --quiet --compile-bytecode --python .venv/bin/python -r requirements.lock; then
  echo "setup: cannot install what requirements.lock pins. Its packages exist for Linux (x86-64 and aarch64), macOS" >&2
  echo "       (Apple silicon) and Windows (x86-64). If this is one of them, the reason is above; run make setup again." >&2
  exit 1
fi
"$uv" pip install --quiet --python .venv/bin/python --no-deps -e .
touch "$stamp"
echo "installed into .venv"
