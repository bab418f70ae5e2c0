#!/usr/bin/env bash
# Writes requirements.lock from pyproject.toml: what `make setup` installs, for each platform of [tool.uv] there.
# The versions locked now stay; `scripts/compile_lock.sh --upgrade-package NAME` takes a newer one.
set -euo pipefail
cd "$(dirname "$0")/.."
uv=$(command -v uv || ls .tools/bin/uv .tools/lib/bin/uv 2>/dev/null | head -1 || true)
if [ -z "$uv" ]; then
  echo "compile_lock: uv is missing. Run make setup first, which installs it." >&2
  exit 1
fi

compiled=$(mktemp)
trap 'rm -f "$compiled"' EXIT
cp requirements.lock "$compiled"
"$uv" pip compile --quiet --universal --python-version 3.12 --no-annotate --no-header --no-emit-index-url \
  --extra cluster --extra dev --extra docs --extra ground-truth --extra label --extra onnx --output-file "$compiled" "$@" \
  pyproject.toml >/dev/null

# uv repeats the list of platforms on every line. What every platform needs carries no marker here.
cpython="platform_python_implementation != 'PyPy' and "
mac="(platform_machine == 'arm64' and sys_platform == 'darwin')"
linux="(platform_machine == 'aarch64' and sys_platform == 'linux') or (platform_machine == 'x86_64' and sys_platform == 'linux')"
windows="(platform_machine == 'AMD64' and sys_platform == 'win32')"
sed -e "/implementation_name == 'pypy'/d" \
  -e "s/python_full_version < '3.14' and //" -e "s/$cpython//g" \
  -e "s/ ; ($mac or $linux or $windows)\$//" \
  -e "s/($mac or $linux)\$/sys_platform != 'win32'/" \
  -e "s/($linux)\$/sys_platform == 'linux'/" \
  -e "s/platform_machine == '[A-Za-z0-9]*' and //" \
  "$compiled" >requirements.lock
