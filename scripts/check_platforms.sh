#!/usr/bin/env bash
# Asks for each supported platform whether requirements.lock can be installed there. Needs the package index; installs nothing.
set -euo pipefail
cd "$(dirname "$0")/.."
uv=$(command -v uv || ls .tools/bin/uv .tools/lib/bin/uv 2>/dev/null | head -1 || true)
if [ -z "$uv" ]; then
  echo "check_platforms: uv is missing. Run make setup first, which installs it." >&2
  exit 1
fi

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
answer=$folder/answer
failed=0
for platform in x86_64-unknown-linux-gnu aarch64-unknown-linux-gnu aarch64-apple-darwin x86_64-pc-windows-msvc; do
  if "$uv" pip install --dry-run --only-binary :all: --target "$folder/target" --python-version 3.12 \
    --python-platform "$platform" -r requirements.lock >"$answer" 2>&1; then
    echo "$platform: $(grep -c '^ + ' "$answer") packages"
  else
    failed=1
    echo "$platform: does not resolve" >&2
    sed 's/^/    /' "$answer" >&2
  fi
done
if [ "$failed" = 1 ]; then
  echo "check_platforms: give the packages named above a marker in pyproject.toml, then run scripts/compile_lock.sh." >&2
  exit 1
fi
