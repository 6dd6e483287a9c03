#!/usr/bin/env bash
# Installs Khronos' glTF validator under build/. Without Node.js it says so and goes on: only its own tests are skipped.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
target=$here/../../build/gltf_validator
mkdir -p "$target"
if ! command -v npm >/dev/null || ! command -v node >/dev/null; then
  echo "no Node.js here: the tests of surface.glb against Khronos' validator will be skipped (tools/system_packages.sh installs it)"
  exit 0
fi
cp "$here/package.json" "$here/package-lock.json" "$target/"
if (cd "$target" && npm ci --silent --no-audit --no-fund); then
  touch "$target/.ready"
else
  echo "npm could not install the glTF validator: the tests that need it will be skipped"
fi
