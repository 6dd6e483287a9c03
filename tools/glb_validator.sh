#!/usr/bin/env bash
# Installs Khronos' glTF validator beside the tests that use it. Without Node.js it says so and goes on: only those tests
# are skipped, by name.
set -euo pipefail
cd "$(dirname "$0")/../tests/glb_validator"
if ! command -v npm >/dev/null || ! command -v node >/dev/null; then
  echo "no Node.js here: the tests of surface.glb against Khronos' validator will be skipped (tools/system_packages.sh)"
  exit 0
fi
if npm ci --silent --no-audit --no-fund; then
  touch node_modules/.ready
else
  echo "npm could not install the glTF validator: the tests that need it will be skipped"
fi
