#!/usr/bin/env bash
# Installs what a folder's package-lock.json names beside the tests that use it:
#   tools/npm_packages.sh FOLDER WHAT NEEDS IT
# Without Node.js it says so and goes on: only those tests are skipped, by name.
set -euo pipefail
cd "$(dirname "$0")/../$1"
shift
if ! command -v npm >/dev/null || ! command -v node >/dev/null; then
  echo "no Node.js here: $* will be skipped (tools/system_packages.sh)"
  exit 0
fi
if npm ci --silent --no-audit --no-fund --ignore-scripts; then
  touch node_modules/.ready
else
  echo "npm could not install its packages: $* will be skipped"
fi
